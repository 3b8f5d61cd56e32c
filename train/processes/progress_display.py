"""What is shown while runs are at work: a live table on a terminal, now and then a few lines in a file or a pipe."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from rich.console import Console
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from .pace import Pace, left_text, speed_text

_EVERY_S: Final = 30.0
_RARER: Final = 0.05
"""Lines come after this share of the time so far, if that is longer: a night's log stays short."""


@dataclass
class _Row:
    """One job as it is shown."""

    total: int
    done: int = 0
    running: bool = False
    pace: Pace = field(default_factory=Pace)
    figures: Mapping[str, str] = field(default_factory=dict)

    @property
    def left_s(self) -> float:
        """Time left at its own speed, s; inf while that is unknown."""
        speed = self.pace.lately
        return (self.total - self.done) / speed if speed > 0 else math.inf


class ProgressDisplay:
    """All jobs together with the time they still take, and each one that is running.

    Args:
        title: Of the whole, such as "Training".
        unit: What is counted, in the plural.
        totals: Units of each job, by its name.
        console: A terminal gets a table that is kept up to date; anything else lines.
        clock: s; for tests.
        before: Units of jobs that were done before these.
        later: Units of jobs that begin when these are done; the time left is of all.
    """

    def __init__(
        self,
        title: str,
        unit: str,
        totals: Mapping[str, int],
        console: Console,
        clock: Callable[[], float] = time.monotonic,
        before: int = 0,
        later: int = 0,
    ) -> None:
        self._before = before
        self._others = before + later
        self._title = title
        self._unit = unit
        self._rows = {name: _Row(total) for name, total in totals.items()}
        self._console = console
        self._clock = clock
        self._begun = self._said_at = clock()
        self._live = Live(get_renderable=self.table, console=console, refresh_per_second=4, transient=True)

    def __enter__(self) -> ProgressDisplay:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def start(self, name: str) -> None:
        """A job begins."""
        self._rows[name].running = True
        if not self._console.is_terminal:
            self.say(f"{name}: started ({self._rows[name].total:,} {self._unit})")

    def steps(self, name: str, done: int) -> None:
        """So many units of a job are done."""
        row = self._rows[name]
        row.done = min(done, row.total)
        row.pace.report(self._clock(), done)

    def figures(self, name: str, figures: Mapping[str, str]) -> None:
        """What a job has to show beside its progress, by what it is."""
        self._rows[name].figures = figures

    def end(self, name: str, how: str) -> None:
        """A job ended: "done", "failed" or "stopped"."""
        row = self._rows[name]
        row.running, row.done = False, row.total
        style = {"done": "green", "failed": "red"}.get(how, "yellow")
        speed = speed_text(row.pace.overall, self._unit)
        self._print(Text.assemble(f"{name}: ", (how, style), f", {speed}" if speed else ""))

    def say(self, text: str) -> None:
        """A line for a person."""
        self._print(Text(text))

    def tick(self) -> None:
        """To be called often: says how things stand when it is time, unless there is a terminal that shows it."""
        now = self._clock()
        if self._console.is_terminal or now - self._said_at < max(_EVERY_S, _RARER * (now - self._begun)):
            return
        self._said_at = now
        done, total, speed, left = self._all()
        self.say(self._line(self._title, done, total, speed, left, [f"{done:,}/{total:,} {self._unit}"]))
        for name, row in self._running().items():
            told = [f"{key} {value}" for key, value in row.figures.items()]
            self.say("  " + self._line(name, row.done, row.total, row.pace.lately, row.left_s, told))

    def table(self) -> Table:
        """The live table."""
        running = self._running()
        figures = list(dict.fromkeys(key for row in running.values() for key in row.figures))
        table = Table(box=None, pad_edge=False, header_style="dim")
        table.add_column("")
        for heading in (self._unit, "", "speed", "left", *figures):
            table.add_column(heading, justify="right", no_wrap=True)
        done, total, speed, left = self._all()
        table.add_row(*self._cells(self._title, done, total, speed, left), *("" for _ in figures))
        for name, row in running.items():
            told = [row.figures.get(key, "") for key in figures]
            table.add_row(*self._cells(name, row.done, row.total, row.pace.lately, row.left_s), *told)
        return table

    def _cells(
        self, name: str, done: int, total: int, speed: float, left: float
    ) -> Sequence[str | ProgressBar]:
        bar = ProgressBar(total, done, width=10)
        counted = f"{100 * done // total} %"
        return name, bar, counted, speed_text(speed, self._unit), left_text(left)

    def _line(self, name: str, done: int, total: int, speed: float, left: float, told: Sequence[str]) -> str:
        words = left_text(left)
        pace = (speed_text(speed, self._unit), f"{words} left" if words else "")
        return f"{name}: " + ", ".join(filter(None, (f"{100 * done // total} %", *told, *pace)))

    def _all(self) -> tuple[int, int, float, float]:
        """Units done, of how many, units per second, and the time left, s: not less than the slowest run's."""
        rows = self._rows.values()
        speed = sum(row.pace.lately for row in rows if row.running)
        done, total = sum(row.done for row in rows), sum(row.total for row in rows)
        done, total = self._before + done, self._others + total
        slowest = max((row.left_s for row in rows if row.running and math.isfinite(row.left_s)), default=0.0)
        return done, total, speed, max((total - done) / speed, slowest) if speed > 0 else math.inf

    def _running(self) -> dict[str, _Row]:
        return {name: row for name, row in self._rows.items() if row.running}

    def _print(self, text: Text) -> None:
        self._console.print(text, soft_wrap=True, highlight=False)
