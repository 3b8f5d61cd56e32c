"""What became of a fault, and how that is judged from one step or an episode."""

from collections.abc import Callable, Iterable
from enum import StrEnum
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from benchmarks.faults.episodes import plain
from benchmarks.faults.stacks import Answer, Row, Session, same
from safe_wrappers.errors import SafeWrappersError


class Outcome(StrEnum):
    """How a cell of the matrix ends; what each means says `MEANS`."""

    REFUSED = "refused"
    FLAGGED = "flagged"
    ERROR = "error"
    HARMLESS = "harmless"
    PASSED = "passed on"
    KEPT = "kept"
    WAITS = "waits"
    NOT_APPLICABLE = "-"
    SILENT = "SILENT"
    NON_FINITE = "NON-FINITE"
    OUTSIDE = "OUTSIDE"
    CRASHED = "CRASHED"
    DIVERGED = "DIVERGED"


MEANS: dict[Outcome, str] = {
    Outcome.REFUSED: "an error of this library that says what was expected, before the env was stepped",
    Outcome.FLAGGED: "info says so, or a warning; what was executed is finite and in the action space",
    Outcome.ERROR: "the error of the env, a solver or `pickle`, or one of ours about what the env returned",
    Outcome.HARMLESS: "bit for bit as without the fault",
    Outcome.PASSED: "the wrapper decides nothing here: the env got what it would have got without it, finite numbers",
    Outcome.KEPT: "the limit was kept, judged with the right model",
    Outcome.WAITS: "the step takes as long as what hangs",
    Outcome.NOT_APPLICABLE: "there is nothing that the fault could hit",
    Outcome.SILENT: "something else happened than without the fault, and nothing says so",
    Outcome.NON_FINITE: "a number that is not finite reached the env",
    Outcome.OUTSIDE: "an action outside the action space reached the env through a wrapper that decides",
    Outcome.CRASHED: "an error that does not say what was expected",
    Outcome.DIVERGED: "the next episode, or that of a copy, is another one",
}
DEFECTS = (Outcome.SILENT, Outcome.NON_FINITE, Outcome.OUTSIDE, Outcome.CRASHED, Outcome.DIVERGED)


class Found(NamedTuple):
    """An outcome, and what was said."""

    outcome: Outcome
    note: str = ""


Cell = Callable[[Session], Found]
"""What a cell of the matrix does with a new session."""


OF_OURS = (SafeWrappersError, gym.error.ResetNeeded)
_FLAGS = (
    "cbf/infeasible", "cbf/fallback", "cbf/nonfinite", "cbf/unsafe", "cbf/clipped", "cbf/intervened",
    "handover/refused", "handover/starved", "handover/limited", "handover/clipped", "lease/refused", "lease/braking",
    "lease/expired", "lease/clipped", "teleop/revoked", "teleop/lost", "teleop/clipped", "contact/partial",
    "balance/partial", "occlusion/expired", "fault/active",
)  # fmt: skip


def flags(info: dict[str, Any], usual: dict[str, Any]) -> list[str]:
    """The keys by which info says that something is not as usual."""
    return [key for key in _FLAGS if np.any(info.get(key, False)) and not np.any(usual.get(key, False))]


def reached_wrongly(session: Session, answers: Iterable[Answer]) -> Found | None:
    """A defect in what reached the env, if there is one."""
    space: Any = session.bottoms[0].action_space
    for given in (one for answer in answers for one in answer.reached):
        if given.dtype.kind in "fc" and not np.isfinite(given).all():
            return Found(Outcome.NON_FINITE, f"the env was given {given}")
        if given.dtype.kind not in "fiub" or not space.contains(given.astype(space.dtype)):
            return Found(Outcome.OUTSIDE, f"the env was given {given}")
    return None


def judged(
    row: Row, session: Session, answer: Answer, usual: Answer, alone: Callable[[], Answer] | None
) -> Found:
    """The outcome of one step.

    Args:
        row: The row.
        session: In which the fault was.
        answer: Of the step with the fault.
        usual: Of the same step without it.
        alone: Makes the same step with the fault in the bare env; None where the fault does not reach it.
    """
    error = answer.error
    wrong = reached_wrongly(session, [answer])
    as_alone = row.passes and alone is not None
    if wrong is not None and not (wrong.outcome is Outcome.OUTSIDE and as_alone):
        return wrong
    if error is not None:
        text = f"{type(error).__name__}: {error}"
        if isinstance(error, OF_OURS) and not answer.reached:
            return Found(Outcome.REFUSED, text)
        # What this library says of what the env has returned, or the env's own.
        own = isinstance(error, OF_OURS) or (alone is not None and type(alone().error) is type(error))
        return Found(Outcome.ERROR if own else Outcome.CRASHED, text)
    if wrong is None and same(answer, usual):
        return Found(Outcome.HARMLESS)
    found = flags(answer.info, usual.info)
    new = [text for text in answer.warned if text not in usual.warned]
    if found or any("the policy's action" in text or "operator's action" in text for text in new):
        return Found(Outcome.FLAGGED, ", ".join([*found, *new]))
    if as_alone and alone is not None and _continues(answer, alone()):
        return Found(Outcome.PASSED, ", ".join(new))
    return Found(Outcome.SILENT, ", ".join(new))


def _continues(answer: Answer, alone: Answer) -> bool:
    """Whether the env has gone on as it would have alone: the same reached it."""
    return plain(tuple(answer.reached[:1])) == plain(tuple(alone.reached[:1]))
