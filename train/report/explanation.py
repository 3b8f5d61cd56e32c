"""What each number of a page is: what it counts, its unit, and when there is none; from the registry."""

from __future__ import annotations

import re
from collections.abc import Iterable

from ..evaluation.metrics import REGISTRY, absent
from .markup import number_id, text


def explanations(names: Iterable[str]) -> str:
    """An entry per number, in the registry's order; the tables' headings lead to them.

    Args:
        names: Of the numbers on the page.
    """
    wanted = set(names)
    entries = "".join(_entry(name) for name in REGISTRY if name in wanted)
    return f'<dl class="numbers">{entries}</dl>'


def _entry(name: str) -> str:
    metric = REGISTRY[name]
    facts = [f"<i>Unit:</i> {text(metric.unit)}."] if metric.unit else []
    if absent(name):
        facts.append(f"<i>Absent:</i> {_with_code(absent(name))}")
    more = f"<dd>{' '.join(facts)}</dd>" if facts else ""
    return (
        f'<div id="{number_id(name)}"><dt>{text(metric.label)} <code>{text(name)}</code></dt>'
        f"<dd>{text(metric.counts)}</dd>{more}</div>"
    )


def _with_code(sentence: str) -> str:
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", text(sentence))
