"""How fast something goes, and how long it will still take."""

from __future__ import annotations

import math
from collections import deque
from datetime import timedelta
from typing import Final

_WINDOW_S: Final = 15.0
"""Shorter than the first lines come: an off-policy learner's random actions are soon forgotten."""


class Pace:
    """Units per second, lately and over all, from reports of how many are done."""

    def __init__(self) -> None:
        self._reports: deque[tuple[float, float]] = deque()
        self._first: tuple[float, float] | None = None

    def report(self, now: float, done: float) -> None:
        """Notes that so many units are done; what the first report has was made before.

        Args:
            now: s, of any clock that does not go back.
            done: Units.
        """
        self._first = self._first or (now, done)
        self._reports.append((now, done))
        while len(self._reports) > 2 and self._reports[1][0] < now - _WINDOW_S:
            self._reports.popleft()

    @property
    def lately(self) -> float:
        """Units per second over the last 15 s; 0 while unknown."""
        return _rate(self._reports[0], self._reports[-1]) if self._reports else 0.0

    @property
    def overall(self) -> float:
        """Units per second since the first report; 0 while unknown."""
        return _rate(self._first, self._reports[-1]) if self._first is not None else 0.0


def _rate(first: tuple[float, float], last: tuple[float, float]) -> float:
    return (last[1] - first[1]) / (last[0] - first[0]) if last[0] > first[0] else 0.0


def speed_text(per_second: float, unit: str) -> str:
    """`812 steps/s`, or for what is slow `2.5 s/episode`; empty while unknown.

    Args:
        per_second: Units per second.
        unit: In the plural.
    """
    if per_second <= 0:
        return ""
    if per_second < 1:
        return f"{1 / per_second:.1f} s/{unit.removesuffix('s')}"
    return f"{per_second:,.0f} {unit}/s"


def left_text(seconds: float) -> str:
    """Time left, `0:03:20`; empty while unknown, which is inf."""
    return str(timedelta(seconds=round(seconds))) if math.isfinite(seconds) else ""
