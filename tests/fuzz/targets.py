"""All targets by their names."""

from fuzz import configurations, files, folders, servers, streams
from fuzz.engine import Target

TARGETS: dict[str, Target] = {
    target.name: target for targets in (configurations, files, streams, folders, servers) for target in targets.TARGETS
}
