"""The page of a report: one static HTML file without scripts, which opens from disk years later."""

import html


def page(title: str, body: str) -> str:
    """The page around a body of HTML; what is no text in Unicode, such as half of a surrogate pair, becomes "?"."""
    text = _PAGE.format(title=html.escape(title), style=_STYLE, body=body)
    return text.encode("utf-8", "replace").decode("utf-8")


_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1150px; margin: 2em auto; padding: 0 1em; color: #222; }
table { border-collapse: collapse; margin: 1em 0; }
td, th { padding: .25em .8em; border-bottom: 1px solid #ddd; text-align: left; vertical-align: top; }
.row { display: flex; flex-wrap: wrap; gap: 12px; }
figure { margin: 0 0 1em 0; }
.picture img { width: 270px; image-rendering: pixelated; display: block; }
.wide img { max-width: 100%; }
figcaption { color: #555; }
.warn { color: #a33; }
pre { background: #f5f5f5; padding: 1em; overflow-x: auto; }
"""
_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>{style}</style></head>
<body>
{body}
</body></html>
"""
