"""What a picture is on the page: a title, the drawing, its marks, a sentence that reads it, and its numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from ..files import Row

Look = Literal["fill", "line", "dot", "ring", "disc"]
Key = tuple[str, Look]
"""A CSS colour variable of the page's style, without the dashes, and how the mark looks."""


@dataclass(frozen=True)
class Plotted:
    """The drawn numbers as a table for a CSV file; cells of what does not exist are left out."""

    name: str
    """Unique on the page, as in its SVG."""
    columns: tuple[str, ...]
    rows: Sequence[Row]


@dataclass(frozen=True)
class Picture:
    """A picture, or, where there is nothing to draw, only the sentence that says so."""

    title: str
    reading: str
    svg: str = ""
    keys: Mapping[str, Key] = field(default_factory=dict)
    """What the marks mean: plain text -> its look."""
    data: Plotted | None = None


def per_arm(told: Mapping[str, str]) -> str:
    """What is told of each arm as sentences; the arms are named where there are several.

    Args:
        told: arm -> a sentence without its capital and its full stop.
    """
    named = (
        f"“{arm}”: {what}." if len(told) > 1 else f"{what[:1].upper()}{what[1:]}."
        for arm, what in told.items()
    )
    return " ".join(named)
