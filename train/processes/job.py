"""Jobs: what runs elsewhere, where, and what it reports."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

Message = tuple[str, Any]
"""`steps`, `figures`, `say`, `failed`, or at last `end` with what killed it, "" for nothing."""


@dataclass(frozen=True)
class Progress:
    """Where a job reports to: its steps so far, lines that a person should read, and figures by their names."""

    steps: Callable[[int], None]
    say: Callable[[str], None]
    figures: Callable[[Mapping[str, str]], None] = lambda _: None


@dataclass(frozen=True)
class Job:
    """One process's work: `call(*arguments, progress)`; both must pickle."""

    name: str
    total: int
    unit: str
    call: Callable[..., None]
    arguments: tuple[Any, ...]


class Workers(Protocol):
    """Where jobs run; `at_once` is how many at a time."""

    at_once: int

    def start(self, job: Job) -> None:
        """Begins a job."""

    def messages(self, timeout_s: float) -> Iterator[tuple[str, Message]]:
        """What jobs have to say, by their names; waits for the first of it, for at most so long."""

    def stop(self, name: str) -> None:
        """Asks a job to save and end."""

    def kill(self) -> None:
        """Ends all jobs at once."""
