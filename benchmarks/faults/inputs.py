"""Faults of the action that a policy gives."""

import functools
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.faults.outcomes import Found, Outcome, judged
from benchmarks.faults.stacks import BEFORE, Answer, Row, Session

Change = Callable[[Any], Any]


def _filled(value: float) -> Change:
    return lambda action: np.full(np.shape(action), value)


def _first(value: float) -> Change:
    def change(action: Any) -> Any:
        given = np.array(action, dtype=np.float64)
        given.flat[0] = value
        return given

    return change


def _read_only(action: Any) -> Any:
    given = np.array(action)
    given.flags.writeable = False
    return given


def _strided(action: Any) -> Any:
    given = np.asarray(action)
    return np.repeat(given, 2, axis=-1)[..., ::2] if given.ndim else given


def _as_list(action: Any) -> Any:
    return np.asarray(action).tolist()


SPOILED: dict[str, dict[str, Change]] = {
    "NaN": {"all": _filled(np.nan), "first": _first(np.nan)},
    "Inf": {"all": _filled(np.inf), "first, negative": _first(-np.inf)},
    "huge": {"1e30": _filled(1e30), "1e300": _first(-1e300)},
    "wrong dtype": {
        "text": lambda action: np.full(np.shape(action), "0.1"),
        "complex": lambda action: np.asarray(action) * (0.5 + 0.5j),
        "None": lambda action: None,
        "objects": lambda action: np.full(np.shape(action), None),
        "dates": lambda action: np.full(np.shape(action), "2020-01-01", dtype="datetime64[D]"),
    },
    "wrong shape": {
        "longer": lambda action: np.concatenate([np.atleast_1d(action)] * 2, axis=-1),
        "a row": lambda action: np.asarray(action)[None],
        "a number": lambda action: 0.5,
        "empty": lambda action: np.zeros(0),
    },
}
"""Column -> variant -> what is given in place of an action."""

KEPT: dict[str, dict[str, Change]] = {
    "denormal": {"float64": _filled(5e-324), "float32": lambda a: np.full(np.shape(a), 1e-45, np.float32)},
    "read-only array": {"": _read_only},
    "non-contiguous": {"": _strided},
    "float16": {"": lambda action: (np.asarray(action) * 0.5).astype(np.float16)},
    "list": {"": _as_list},
}
"""Column -> variant -> the same numbers in another form."""


def inputs(row: Row) -> dict[tuple[str, str], Callable[[Session], Found]]:
    """The cells of a row."""

    def without_a_fault(action: Any) -> Answer:
        return row.open().begin().step(action)

    usual = functools.cache(lambda: without_a_fault(row.open().actions[BEFORE]))

    def cell(change: Change, same_numbers: bool) -> Callable[[Session], Found]:
        def run(session: Session) -> Found:
            session.begin()
            action = session.actions[BEFORE]
            space: Any = session.env.action_space
            discrete = isinstance(space, gym.spaces.Discrete)
            spoiled = change(action if same_numbers or not discrete else np.float64(action))
            plain = action
            if same_numbers:
                numbers = np.array(spoiled)
                kind = numbers.dtype if numbers.dtype == np.float64 else space.dtype
                plain = int(numbers) if discrete else numbers.astype(kind)
            answer = session.step(spoiled)
            expected = without_a_fault(plain) if same_numbers else usual()
            found = judged(row, session, answer, expected, lambda: row.bare().begin().step(spoiled))
            if (
                same_numbers
                and found.outcome is Outcome.SILENT
                and np.array_equal(answer.reached, expected.reached)
            ):
                return Found(Outcome.PASSED, "the env's own arithmetic is that of what it was given")
            return found

        return run

    columns = [(column, variants, False) for column, variants in SPOILED.items()]
    columns += [(column, variants, True) for column, variants in KEPT.items()]
    return {
        (column, variant): cell(change, same_numbers)
        for column, variants, same_numbers in columns
        for variant, change in variants.items()
    }
