"""Faults of an env's life: it raises, is reset, shared by threads, copied, closed."""

import copy
import pickle
import threading
import warnings
from collections.abc import Callable
from typing import Any

from benchmarks.faults.episodes import plain
from benchmarks.faults.outcomes import OF_OURS, Cell, Found, Outcome
from benchmarks.faults.stacks import BEFORE, BrokenEnvError, Row, Session, same


def _raises(where: str) -> Cell:
    def run(session: Session) -> Found:
        session.begin()
        session.bottoms[0].breaks = where
        error: Exception | None = None
        if where == "step":
            error = session.step(session.actions[BEFORE]).error
        else:
            try:
                session.env.reset(seed=1)
            except Exception as raised:
                error = raised
        session.bottoms[0].breaks = ""
        text = f"{type(error).__name__}: {error}"
        if error is None:
            return Found(Outcome.SILENT, "the env's error was swallowed")
        return Found(Outcome.ERROR if isinstance(error, BrokenEnvError) else Outcome.CRASHED, text)

    return run


def _reset(session: Session) -> Found:
    session.begin()
    return Found(Outcome.HARMLESS)  # the episode that follows is compared for every cell


def _second(act: str) -> Cell:
    """A second thread, while the first is in the env."""

    def run(session: Session) -> Found:
        session.begin()
        inside, go_on = session.bottoms[0].block()
        first = threading.Thread(target=session.step, args=(session.actions[BEFORE],))
        first.start()
        inside.wait(20.0)
        error: Exception | None = None
        try:
            with warnings.catch_warnings(action="ignore"):
                if act == "reset":
                    session.env.reset(seed=0)
                else:
                    session.env.step(session.actions[BEFORE])
        except Exception as raised:
            error = raised
        go_on.set()
        first.join(20.0)
        if error is None:
            return Found(Outcome.SILENT, f"a second thread's {act} ran in the middle of a step")
        ours = isinstance(error, OF_OURS)
        return Found(Outcome.REFUSED if ours else Outcome.CRASHED, f"{type(error).__name__}: {error}")

    return run


def _copied(make: Callable[[Any], Any]) -> Callable[[Row], Cell]:
    def cell(row: Row) -> Cell:
        def run(session: Session) -> Found:
            session.begin()
            usual = row.open().begin()
            try:
                again = make(session.env)
            except Exception as error:
                text = f"{type(error).__name__}: {error}"
                unpicklable = isinstance(error, pickle.PicklingError | AttributeError | TypeError)
                return Found(Outcome.ERROR if unpicklable else Outcome.CRASHED, text)
            found = Found(Outcome.HARMLESS)
            its = Session(again, [])
            for action in session.actions[BEFORE:]:
                mine, expected = session.step(action), usual.step(action)
                if not same(mine, expected):
                    return Found(Outcome.DIVERGED, "the original goes on differently")
                if found.outcome is Outcome.HARMLESS:
                    answer = its.step(action)
                    if isinstance(answer.error, OF_OURS):
                        text = f"{type(answer.error).__name__}: {answer.error}"
                        found = Found(Outcome.REFUSED, text)
                    elif not same(answer, expected):
                        found = Found(Outcome.DIVERGED, "the copy goes on from another state")
                if session.ended(mine):
                    break
            if plain(its.episode()) != plain(row.open().episode()):
                return Found(Outcome.DIVERGED, "the copy's next episode is another one")
            return found

        return run

    return cell


def _closed(session: Session) -> Found:
    session.begin()
    session.env.close()
    try:
        session.env.close()
    except Exception as error:
        return Found(Outcome.CRASHED, f"{type(error).__name__}: {error}")
    return Found(Outcome.HARMLESS)


def lifecycle(row: Row) -> dict[tuple[str, str], Cell]:
    """The cells of a row."""
    return {
        ("env raises", "in step"): _raises("step"),
        ("env raises", "in reset"): _raises("reset"),
        ("reset in the middle", ""): _reset,
        ("two threads", "step"): _second("step"),
        ("two threads", "reset"): _second("reset"),
        ("pickled in the middle", ""): _copied(lambda env: pickle.loads(pickle.dumps(env)))(row),
        ("deep-copied in the middle", ""): _copied(copy.deepcopy)(row),
        ("closed twice", ""): _closed,
    }
