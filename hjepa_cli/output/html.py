"""Self-contained HTML: every text is escaped, every picture is inside the file, no script."""

import base64
import itertools
from collections.abc import Mapping, Sequence
from html import escape
from string import Template
from typing import Any

TEXT = ' class="text"'
PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy"
 content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<title>$title</title>
<style>
body { font: 16px/1.5 system-ui, sans-serif; color: #222; background: #fff;
       max-width: 64rem; margin: 2rem auto; padding: 0 1rem; }
h1, h2, h3 { line-height: 1.2; } h2 { border-top: 1px solid #ccc; padding-top: 1rem; }
.table { overflow-x: auto; margin: 1rem 0; }
table { border-collapse: collapse; font-size: 0.8rem; }
th, td { padding: 0.2rem 0.45rem; border-bottom: 1px solid #ddd; text-align: right;
         white-space: nowrap; }
th.text, td.text, th:first-child, td:first-child { text-align: left; }
td.text:not(:first-child) { white-space: normal; }
pre, code { background: #f5f5f5; font-size: 0.85rem; } pre { padding: 0.6rem;
      white-space: pre-wrap; overflow-wrap: anywhere; }
figure { margin: 1rem 0; display: inline-block; vertical-align: top; width: 27rem;
         max-width: 100%; }
figure img { width: 100%; } figcaption { color: #555; font-size: 0.9rem; }
.note { background: #fff3cd; padding: 0.4rem 0.8rem; }
@media print { details[open] { display: block; } }
</style>
</head>
<body>
$body
</body>
</html>
""")


def page(title: str, parts: Sequence[str]) -> str:
    """A complete document. ``parts`` are HTML, ``title`` is text."""
    return PAGE.substitute(title=escape(title), body="\n".join(parts))


def heading(level: int, text: str) -> str:
    """``<h2>text</h2>``."""
    return f"<h{level}>{escape(text)}</h{level}>"


def paragraph(text: str, *, note: bool = False) -> str:
    """A paragraph; a note stands out."""
    return f"<p{' class=note' if note else ''}>{escape(text)}</p>"


def code(text: str) -> str:
    """A block of commands or of a file."""
    return f"<pre><code>{escape(text)}</code></pre>"


def details(summary: str, content: str) -> str:
    """Something long, closed at first. ``content`` is HTML."""
    return f"<details><summary>{escape(summary)}</summary>{content}</details>"


def table(columns: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A table of texts and numbers; ``None`` is an empty cell."""
    lines = ["".join(map(_cell, row)) for row in rows]
    words = [all(map(_is_text, cells)) for cells in zip(*rows, strict=True)]
    head = "".join(
        f"<th{TEXT if is_text else ''}>{escape(column)}</th>"
        for column, is_text in itertools.zip_longest(columns, words)
    )
    body = "\n".join(f"<tr>{line}</tr>" for line in lines)
    inside = f"<thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody>"
    return f'<div class="table"><table>{inside}</table></div>'


def pairs(values: Mapping[str, Any]) -> str:
    """A table of names and values."""
    return table(["", ""], [[name, value] for name, value in values.items()])


def picture(data: bytes, kind: str, caption: str) -> str:
    """An image inside the document. ``kind``: ``"svg+xml"``, ``"png"`` or ``"gif"``.

    An SVG inside ``<img>`` runs no script and shares no element ids with its neighbours.
    """
    source = f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
    image = f'<img src="{source}" alt="{escape(caption)}">'
    return f"<figure>{image}<figcaption>{escape(caption)}</figcaption></figure>"


def _cell(value: object) -> str:
    text = "" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)
    return f"<td{TEXT if _is_text(value) else ''}>{escape(text)}</td>"


def _is_text(value: object) -> bool:
    """Not a number, nor a text that begins with one."""
    return isinstance(value, str) and not (value[:1].isdigit() or value[:1] in "-+<>≥≤")
