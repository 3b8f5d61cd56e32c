"""The pieces of HTML that both pages are made of; every text is escaped here."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from ..evaluation.metrics import REGISTRY
from ..evaluation.summary import number
from ..figures.picture import Key, Picture
from ..figures.plot_files import PlotFiles
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


def pictures(items: Iterable[Picture], files: PlotFiles | None = None) -> str:
    """Pictures side by side, each with its title, its keys and its reading; what has no drawing is a line, last.

    Args:
        items: The pictures.
        files: Gets what they are drawn from, and each has a link to its file; without, there are none.
    """
    items = list(items)
    items.sort(key=lambda item: not item.svg)
    inside = "".join(_figure(item, files) for item in items)
    return f'<div class="figures">{inside}</div>' if items else ""


def _figure(item: Picture, files: PlotFiles | None) -> str:
    if not item.svg:
        return f'<div class="card told"><h3>{text(item.title)}</h3><p>{text(item.reading)}</p></div>'
    link = "" if files is None or item.data is None else f" {_csv(files.link(item.data), item.title)}"
    return (
        f"<figure><h3>{text(item.title)}</h3>{keys(item.keys) or '<p></p>'}{item.svg}"
        f"<figcaption>{text(item.reading)}{link}</figcaption></figure>"
    )


def _csv(href: str, of: str) -> str:
    return f'<a class="csv" href="{text(href)}" aria-label="{text(of)}, as CSV">CSV</a>'


def keys(items: Mapping[str, Key]) -> str:
    """What the marks of a picture mean."""
    if not items:
        return ""
    marks = "".join(
        f'<span class="key"><i class="{look}" style="--mark-color: var(--{color})"></i>{text(name)}</span>'
        for name, (color, look) in items.items()
    )
    return f'<p class="keys">{marks}</p>'


def explained(name: str, label: str = "") -> str:
    """A number's heading, a link to its explanation on the same page.

    Args:
        name: In the registry of numbers.
        label: What is written; its label in the registry if not given.
    """
    words = text(label or REGISTRY[name].label).replace(" / ", "\N{NO-BREAK SPACE}/ ")
    return f'<a class="number" href="#{number_id(name)}">{words}</a>'


def number_id(name: str) -> str:
    """Where on a page a number is explained."""
    return f"number-{name}"


def table(columns: Sequence[str], rows: Iterable[Sequence[Any]], heads: Iterable[str] = ()) -> str:
    """Plain values, escaped; numbers rounded as everywhere.

    Args:
        columns: Headings, plain text.
        rows: Values.
        heads: Headings in HTML, in place of `columns`.
    """
    head = "".join(f'<th scope="col">{head}</th>' for head in heads or map(text, columns))
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
