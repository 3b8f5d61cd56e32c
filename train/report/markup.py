"""The pieces of HTML that both pages are made of; every text is escaped here."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from ..evaluation.summary import number
from ..figures.picture import Key, Picture
from .style import STYLE


def text(value: object) -> str:
    """A text for a page, escaped."""
    return html.escape(str(value), quote=True)


def document(title: str, body: str) -> str:
    """A whole page that asks for nothing from outside."""
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<link rel="icon" href="data:,">
<title>{text(title)}</title>
<style>{STYLE}</style>
</head>
<body>
<main>
{body}
</main>
</body>
</html>
"""


def section(title: str, *parts: str) -> str:
    """A part of the page under its own heading; empty if it holds nothing."""
    inside = "\n".join(part for part in parts if part)
    return f"<section><h2>{text(title)}</h2>\n{inside}\n</section>" if inside else ""


def card(title: str, value: str, what: str, *others: str, mood: str = "") -> str:
    """A big number with what it counts, and what it is to be compared with; its mood is "", "good" or "bad"."""
    more = "".join(f'<p class="other">{text(other)}</p>' for other in others)
    return (
        f'<div class="card"><h3>{text(title)}</h3><p class="value {mood}">{text(value)}</p>'
        f"<p>{text(what)}</p>{more}</div>"
    )


def pictures(items: Iterable[Picture]) -> str:
    """Pictures side by side, each with its title, its keys and its reading; what has no drawing is a line, last."""
    items = list(items)
    items.sort(key=lambda item: not item.svg)
    return f'<div class="figures">{"".join(map(_figure, items))}</div>' if items else ""


def _figure(item: Picture) -> str:
    if not item.svg:
        return f'<div class="card told"><h3>{text(item.title)}</h3><p>{text(item.reading)}</p></div>'
    return (
        f"<figure><h3>{text(item.title)}</h3>{keys(item.keys) or '<p></p>'}{item.svg}"
        f"<figcaption>{text(item.reading)}</figcaption></figure>"
    )


def keys(items: Mapping[str, Key]) -> str:
    """What the marks of a picture mean."""
    if not items:
        return ""
    marks = "".join(
        f'<span class="key"><i class="{look}" style="--mark-color: var(--{color})"></i>{text(name)}</span>'
        for name, (color, look) in items.items()
    )
    return f'<p class="keys">{marks}</p>'


def table(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Plain values, escaped; numbers rounded as everywhere."""
    head = "".join(f'<th scope="col">{text(column)}</th>' for column in columns)
    body = "".join(
        "<tr>" + "".join(f"<td>{text(number(v) if isinstance(v, float) else v)}</td>" for v in row) + "</tr>"
        for row in rows
    )
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def details(title: str, inside: str) -> str:
    """What is there for those who ask."""
    return f"<details><summary>{text(title)}</summary>{inside}</details>"


def data_uri(kind: str, data: bytes) -> str:
    """A file inside the page."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
