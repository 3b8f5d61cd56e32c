"""Faults of the action that a policy gives."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.faults.outcomes import Found, judged
from benchmarks.faults.stacks import BEFORE, Row, Session

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


def inputs(row: Row) -> dict[tuple[str, str], Callable[[], Found]]:
    """The cells of a row."""
    cells: dict[tuple[str, str], Callable[[], Found]] = {}
    for column, variants in (SPOILED | KEPT).items():
        for variant, change in variants.items():
            cells[column, variant] = _cell(row, change, column in KEPT)
    return cells


def _cell(row: Row, change: Change, same_numbers: bool) -> Callable[[], Found]:
    def run(session: Session) -> Found:
        session.begin()
        action = session.actions[BEFORE]
        space: Any = session.env.action_space
        discrete = isinstance(space, gym.spaces.Discrete)
        spoiled = change(np.float64(action) if discrete else action)
        usual = action
        if same_numbers and not discrete:
            usual = np.array(spoiled, dtype=np.float64 if np.ndim(spoiled) == 0 else None)
            usual = usual.astype(np.float64 if usual.dtype == np.float64 else space.dtype)
        elif same_numbers:
            spoiled = change(action)
            usual = int(np.asarray(spoiled))
        bare = row.bare().begin()
        return judged(
            row,
            session,
            session.step(spoiled),
            row.open().begin().step(usual),
            bare.step(spoiled),
        )

    return run
