"""Faults inside a decision: the state, what a constraint computes from it, and the solver."""

import inspect
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any
from unittest import mock

import daqp
import numpy as np

from benchmarks.faults.episodes import plain
from benchmarks.faults.outcomes import Cell, Found, Outcome, flags, judged, reached_wrongly
from benchmarks.faults.stacks import BEFORE, Answer, Row, Session, same
from safe_wrappers.filter import projection
from safe_wrappers.filter.constraint import HalfSpaces

_HANG_S = 0.02
_CHANGED = {"cbf/intervened": True}
"""A changed action says nothing of the fault."""
_JUDGED_BY_ROWS = 1
"""The last `Stage` whose answer no forecast has seen."""


class SolverError(RuntimeError):
    """What a solver raises that breaks."""


def _state(row: Row, value: float) -> Cell:
    """A step that ends in a state, and returns an observation, which is no number."""

    def steps(session: Session) -> tuple[Answer, Answer]:
        session.begin(BEFORE - 1)
        session.bottoms[0].leaves = value
        return session.step(session.actions[BEFORE - 1]), session.step(session.actions[BEFORE])

    def run(session: Session) -> Found:
        first, second = steps(session)
        usual = row.open().begin(BEFORE - 1)
        before, after = (usual.step(usual.actions[i]) for i in (BEFORE - 1, BEFORE))
        if first.error is not None:
            return judged(row, session, first, before, lambda: steps(row.bare())[0])
        found = judged(row, session, second, after, lambda: steps(row.bare())[1])
        if found.outcome is not Outcome.SILENT:
            return found
        said = flags(first.info, before.info) or flags(second.info, _CHANGED)
        if not said and not session.bound() and plain(tuple(second.reached)) == plain(tuple(after.reached)):
            return Found(Outcome.PASSED, "it reads no state; the observation shows it")
        return Found(Outcome.FLAGGED, ", ".join(said)) if said else found

    return run


class _Spoiled:
    """In place of a constraint's method: counts what is asked, and spoils what is answered from a step on."""

    def __init__(self, method: Callable[..., Any], spoil: Callable[[Any], Any]) -> None:
        self._method, self._spoil = method, spoil
        self.asked = 0

    def __call__(self, *arguments: Any) -> Any:
        self.asked += 1
        return self._spoil(self._method(*arguments))


def _nan_normals(rows: HalfSpaces) -> HalfSpaces:
    return HalfSpaces(np.full((max(1, len(rows.normals)), rows.normals.shape[1]), np.nan), _sized(rows))


def _nan_offsets(rows: HalfSpaces) -> HalfSpaces:
    normals = rows.normals if len(rows.normals) else np.ones((1, rows.normals.shape[1]))
    return HalfSpaces(normals, np.full(len(normals), np.nan))


def _sized(rows: HalfSpaces) -> Any:
    return rows.offsets if rows.offsets.size else np.zeros(1)


def _answers(method: str, spoil: Callable[[Any], Any]) -> Callable[[Row], Cell]:
    def cell(row: Row) -> Cell:
        def run(session: Session) -> Found:
            session.begin()
            bound = session.bound()
            if not bound:
                return Found(Outcome.NOT_APPLICABLE, "it has no constraint")
            spoiled = [_Spoiled(getattr(one, method), spoil) for one in bound]
            with ExitStack() as patches:
                for one, broken in zip(bound, spoiled, strict=True):
                    patches.enter_context(mock.patch.object(one, method, broken, create=True))
                return _rest(row, session, lambda: sum(one.asked for one in spoiled), method)

        return run

    return cell


def _rest(row: Row, session: Session, asked: Callable[[], int], what: str) -> Found:
    """Step to the end of the episode beside one without the fault, and judge the first step that differs."""
    usual = row.open().begin()
    answers: list[Answer] = []
    worst = Found(Outcome.HARMLESS, f"{what} was asked for, and the answers were not used")
    for action in session.actions[BEFORE:]:
        before = asked()
        answer, expected = session.step(action), usual.step(action)
        answers.append(answer)
        wrong = reached_wrongly(session, [answer])
        if wrong is not None:
            return wrong
        if answer.error is not None:
            text = f"{type(answer.error).__name__}: {answer.error}"
            ours = isinstance(answer.error, SolverError)
            return Found(Outcome.ERROR if ours else Outcome.CRASHED, text)
        if not same(answer, expected):
            found = flags(answer.info, expected.info) or flags(answer.info, _CHANGED)
            if not found and not np.isfinite(answer.returned[0]).all():
                found = ["the observation shows it"]
            stage = answer.info.get("cbf/stage", 0)
            if not found and stage > _JUDGED_BY_ROWS and answer.info["cbf/intervened"]:
                found = [f"cbf/stage {stage}: another action that the forecast admits"]
            if not found and asked() > before and not np.any(answer.info.get("cbf/infeasible", False)):
                return Found(Outcome.SILENT, f"stage {answer.info.get('cbf/stage')}")
            return Found(Outcome.FLAGGED, ", ".join(found) or "infeasible")
        if session.ended(answer):
            break
    return worst if asked() else Found(Outcome.NOT_APPLICABLE, f"{what} was never asked for")


def _solver(name: str, broken: Callable[..., Any], then: Outcome = Outcome.HARMLESS) -> Callable[[Row], Cell]:
    """The solver of this name, broken from a step on; `then` where the actions are the right ones all the same."""

    def cell(row: Row) -> Cell:
        def run(session: Session) -> Found:
            if not takes_solver(session):
                return Found(Outcome.NOT_APPLICABLE, "it takes no solver")
            # From the first step on, and what hangs beside itself: answers that differ in their last bits diverge.
            beside = name if then is Outcome.WAITS else "active-set"
            session, usual = row.open(solver=name).begin(0), row.open(solver=beside).begin(0)
            asked: list[int] = []

            def counted(*arguments: Any, **options: Any) -> Any:
                asked.append(1)
                return broken(real, *arguments, **options)

            where, method = _called(name)
            real = getattr(where, method)
            for action in session.actions:
                expected = usual.step(action)
                with mock.patch.object(where, method, counted):
                    answer = session.step(action)
                wrong = reached_wrongly(session, [answer])
                if wrong is not None:
                    return wrong
                if answer.error is not None:
                    text = f"{type(answer.error).__name__}: {answer.error}"
                    own = isinstance(answer.error, SolverError)
                    return Found(Outcome.ERROR if own else Outcome.CRASHED, text)
                if not np.allclose(answer.reached[0], expected.reached[0], atol=1e-4):
                    found = flags(answer.info, _CHANGED)
                    return Found(Outcome.FLAGGED if found else Outcome.SILENT, ", ".join(found))
                if session.ended(answer):
                    break
            return Found(then) if asked else Found(Outcome.NOT_APPLICABLE, "nothing was asked of the solver")

        return run

    return cell


def _called(solver: str) -> tuple[Any, str]:
    """The module and its function that is called for a solver."""
    if solver == "clarabel":
        import qpsolvers  # here: it imports every solver that is installed

        return qpsolvers, "solve_problem"
    return (daqp, "solve") if solver == "daqp" else (projection, "keep_rows")


def takes_solver(session: Session) -> bool:
    """Whether the wrapper has an argument for it."""
    return "solver" in inspect.signature(type(session.env).__init__).parameters


def _raises(real: Any, *arguments: Any, **options: Any) -> Any:
    raise SolverError("the solver broke")


def _hangs(real: Any, *arguments: Any, **options: Any) -> Any:
    time.sleep(_HANG_S)
    return real(*arguments, **options)


def _garbage_daqp(real: Any, *arguments: Any, **options: Any) -> Any:
    x, value, _, info = real(*arguments, **options)
    return x + 3.0, value, 1, info


def _garbage_named(real: Any, *arguments: Any, **options: Any) -> Any:
    solution = real(*arguments, **options)
    solution.found, solution.x, solution.z = True, np.full(arguments[0].q.size, np.nan), None
    return solution


def _missing(row: Row) -> Cell:
    def run(session: Session) -> Found:
        if not takes_solver(session):
            return Found(Outcome.NOT_APPLICABLE, "it takes no solver")
        try:
            row.open(solver="not-installed")
        except Exception as error:
            known = type(error).__name__ == "UnknownNameError"
            return Found(Outcome.REFUSED if known else Outcome.CRASHED, f"{type(error).__name__}: {error}")
        return Found(Outcome.SILENT, "a solver that is not installed was taken")

    return run


def decisions(row: Row) -> dict[tuple[str, str], Cell]:
    """The cells of a row."""
    cells: dict[tuple[str, str], Callable[[Row], Cell]] = {
        ("NaN in the state", "NaN"): lambda row: _state(row, np.nan),
        ("NaN in the state", "Inf"): lambda row: _state(row, np.inf),
        ("NaN in a constraint's value", ""): _answers("value", lambda h: np.full(max(1, h.size), np.nan)),
        ("NaN in rows", "normals"): _answers("rows", _nan_normals),
        ("NaN in rows", "offsets"): _answers("rows", _nan_offsets),
        ("NaN in rows", "slack"): _answers("slack", lambda slack: np.nan),
        ("NaN in rows", "linearized"): _answers("linearize", _nan_offsets),
        ("solver raises", "active-set"): _solver("active-set", _raises),
        ("solver raises", "daqp"): _solver("daqp", _raises),
        ("solver raises", "clarabel"): _solver("clarabel", _raises),
        ("solver hangs", "clarabel"): _solver("clarabel", _hangs, Outcome.WAITS),
        ("solver returns garbage", "daqp"): _solver("daqp", _garbage_daqp),
        ("solver returns garbage", "clarabel"): _solver("clarabel", _garbage_named),
        ("solver is missing", ""): _missing,
    }
    return {key: make(row) for key, make in cells.items()}
