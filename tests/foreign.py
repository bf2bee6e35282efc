"""Markup of someone else's, and whether any of it has become a part of a page."""

from functools import lru_cache
from html.parser import HTMLParser

ATTACK = '"><script>alert(1)</script><img src=x onerror=alert(1)>'


class _Foreign(HTMLParser):
    """Counts elements that no report has."""

    def __init__(self):
        super().__init__()
        self.count = 0

    def handle_starttag(self, tag, attrs):
        self.count += tag == "script" or any(name.startswith("on") or value == "x" for name, value in attrs)


@lru_cache(maxsize=10_000)
def _foreign_element(text: str) -> int:
    """1 if ``text``, which begins with a tag and has no other, begins with an element that no report has."""
    parser = _Foreign()
    parser.feed(text)
    return parser.count


def foreign(page: str) -> int:
    """How many elements of a page no report has.

    Every tag is read for itself, which is done once for those that many pages share.
    """
    return sum(_foreign_element(f"<{part}") for part in page.split("<")[1:]) + page.count("<script")
