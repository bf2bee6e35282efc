"""All targets by their names."""

from fuzz import configurations, files, folders, streams
from fuzz.engine import Target

TARGETS: dict[str, Target] = {
    target.name: target for target in (*configurations.TARGETS, *files.TARGETS, *streams.TARGETS, *folders.TARGETS)
}
