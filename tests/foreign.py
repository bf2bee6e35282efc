"""Markup of someone else's, and whether any of it has become a part of a page."""

from html.parser import HTMLParser

ATTACK = '"><script>alert(1)</script><img src=x onerror=alert(1)>'


class _Foreign(HTMLParser):
    """Counts elements that no report has."""

    def __init__(self):
        super().__init__()
        self.count = 0

    def handle_starttag(self, tag, attrs):
        self.count += tag == "script" or any(name.startswith("on") or value == "x" for name, value in attrs)


def foreign(page: str) -> int:
    """How many elements of a page no report has."""
    parser = _Foreign()
    parser.feed(page)
    return parser.count + page.count("<script")
