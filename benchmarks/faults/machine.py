"""Faults of the machine: a plant that is wrong, a sensor that is silent, a clock that is set."""

import inspect
import time
from collections.abc import Callable
from typing import Any
from unittest import mock

import mujoco
import numpy as np

import safe_wrappers as sw
from benchmarks.faults.outcomes import Cell, Found, Outcome, flags, judged, reached_wrongly
from benchmarks.faults.stacks import BEFORE, Answer, Row, Session
from safe_wrappers.wrappers.cbf_action_filter import SAFE_TOLERANCE, filter_inside
from safe_wrappers.wrappers.layer import CommandReceiver

_PARTS = {
    "mass": ("body_mass", "body_inertia"),
    "damping": ("dof_damping",),
    "friction": ("geom_friction", "pair_friction"),
}
_WRONG = 0.2
_SET_S = 100.0


def _plant(what: str, factor: float) -> Callable[[Row], Cell]:
    """The env is another machine than the filter's plant, whose limit is judged with the right one."""

    def cell(row: Row) -> Cell:
        def run(session: Session) -> Found:
            session = row.open()
            inside = None if hasattr(session.env, "filters") else filter_inside(session.env)
            raw = session.raw()
            if inside is None:
                return Found(Outcome.NOT_APPLICABLE, "it forecasts nothing for the robot")
            if not isinstance(getattr(raw, "model", None), mujoco.MjModel) or inside.plant.simulates:
                return Found(Outcome.NOT_APPLICABLE, "its plant is the env itself, or no MuJoCo model")
            for name in _PARTS[what]:
                getattr(raw.model, name)[:] *= factor
            mujoco.mj_setConst(raw.model, mujoco.MjData(raw.model))
            return _limits_kept(session, inside)

        return run

    return cell


def _late(row: Row) -> Cell:
    """The env acts without a delay, and the plant believes in one."""

    def run(session: Session) -> Found:
        plant = getattr(session.env, "plant", None)
        takes = "plant" in inspect.signature(type(session.env).__init__).parameters
        if not isinstance(plant, sw.MujocoPlant) or not takes or hasattr(session.env, "filters"):
            return Found(Outcome.NOT_APPLICABLE, "it has no MujocoPlant of its own")
        try:
            session = row.open(plant=sw.MujocoPlant(delay_s=_WRONG * plant.control_dt))
        except sw.SafeWrappersError as error:
            return Found(Outcome.REFUSED, f"{type(error).__name__}: {error}")
        return _limits_kept(session, session.env)

    return run


def _limits_kept(session: Session, inside: Any) -> Found:
    judge = sw.CBFActionFilter(inside.env, inside.constraints)
    session.begin(0)
    judge.filter.start()
    violated, flagged = 0, True
    pending = False
    for action in session.actions:
        answer = session.step(action)
        if answer.error is not None:
            return Found(Outcome.CRASHED, f"{type(answer.error).__name__}: {answer.error}")
        wrong = reached_wrongly(session, [answer])
        if wrong is not None:
            return wrong
        said = bool(flags(answer.info, {"cbf/intervened": True}))
        if pending and not said:
            flagged = False
        judge.filter.executed(answer.info["executed_action"])
        judge.filter.observe()
        pending = not judge.filter.margin >= -SAFE_TOLERANCE and not said
        violated += not judge.filter.margin >= -SAFE_TOLERANCE
        if session.ended(answer):
            break
    if not violated:
        return Found(Outcome.KEPT)
    return Found(Outcome.FLAGGED if flagged else Outcome.SILENT, f"{violated} states outside the limit")


def _silent(row: Row) -> Cell:
    """Nothing arrives at a receiver, nothing is seen by a camera, a published fact is gone."""

    def run(session: Session) -> Found:
        session.begin()
        usual = row.open().begin()
        receivers = [one for one in session.layers() if isinstance(one, CommandReceiver)]
        cameras = [one for one in session.layers() if isinstance(one, sw.OcclusionPenalty)]
        published = _published(row)
        if not (receivers or cameras or published):
            return Found(Outcome.NOT_APPLICABLE, "it reads the simulation's own state")
        for camera in cameras:
            camera._sight.sees = lambda points, bodies: np.zeros(len(points), dtype=bool)
        plants = _plants(session) if not (receivers or cameras) else []
        for plant in plants:
            plant.attribute = _without(plant.attribute, published)
        found = Found(Outcome.HARMLESS, "and was not needed")
        for action in session.actions[BEFORE:]:
            for receiver in receivers[:1]:
                receiver.set_observation_time(None)
            expected = usual.step(action)
            answer = session.step(action)
            found = judged(row, session, answer, expected, None)
            said = _less_is_known(answer.info, expected.info)
            if found.outcome is Outcome.SILENT and said:
                found = Found(Outcome.FLAGGED, said)
            # What is in force goes on for a while, as it is meant to; then it has to be said.
            if found.outcome not in (Outcome.HARMLESS, Outcome.SILENT) or session.ended(answer):
                break
        for plant in plants:
            del plant.attribute
        for camera in cameras:
            del camera._sight.sees
        return found

    return run


def _less_is_known(info: dict[str, Any], usual: dict[str, Any]) -> str:
    """What info says of a silence: nothing in sight, a lease that runs down, an old image, no chunk, no command."""
    if "occlusion/visible" in info and not np.any(info["occlusion/visible"]):
        return "occlusion/visible is False, occlusion/sigma grows"
    if "occlusion/sigma" in info and np.any(info["occlusion/sigma"] > usual["occlusion/sigma"]):
        return "occlusion/sigma"
    for key, sign in (("lease/remaining_s", -1), ("teleop/round_trip_s", 1), ("handover/latency", -1)):
        if key in info and sign * (info[key] - usual[key]) > 0.0:
            return key
    return "fault/active" if info.get("fault/active", False) else ""


def _published(row: Row) -> list[str]:
    """The attributes of the env that the constraints read."""
    session = row.open()
    asked: list[str] = []
    for plant in _plants(session):
        plant.attribute = _noted(plant.attribute, asked)
    session.begin(1)
    return sorted(name for name in set(asked) if name.endswith("positions"))


def _plants(session: Session) -> list[Any]:
    return list({id(engine.plant): engine.plant for engine in session.engines()}.values())


def _noted(real: Callable[[str], Any], asked: list[str]) -> Callable[[str], Any]:
    return lambda name: (asked.append(name), real(name))[1]


def _without(real: Callable[[str], Any], silent: list[str]) -> Callable[[str], Any]:
    return lambda name: None if name in silent else real(name)


def _clock(by_s: float) -> Callable[[Row], Cell]:
    """The clocks of the machine, of the simulation, and of who stamps commands."""

    def cell(row: Row) -> Cell:
        def run(session: Session) -> Found:
            session.begin()
            receiver = next((one for one in session.layers() if isinstance(one, CommandReceiver)), None)
            action = session.actions[BEFORE]
            if receiver is not None:
                receiver.set_observation_time(receiver.now_s + by_s)
            _set_time(session, by_s)
            counter = time.perf_counter
            with mock.patch.object(time, "perf_counter", lambda: counter() + by_s):
                answer = session.step(action)

            def alone() -> Answer:
                bare = row.bare().begin()
                _set_time(bare, by_s)
                return bare.step(action)

            usual = row.open().begin().step(action)
            found = judged(row, session, answer, usual, alone)
            said = _less_is_known(answer.info, usual.info)
            if found.outcome is Outcome.SILENT and said:
                return Found(Outcome.FLAGGED, said)
            corrected = answer.info.get("cbf/correction", 0.0) > usual.info.get("cbf/correction", 0.0)
            if found.outcome is Outcome.SILENT and corrected and answer.info["cbf/intervened"]:
                return Found(Outcome.FLAGGED, "cbf/intervened: it begins to measure anew, and corrects more")
            return found

        return run

    return cell


def _set_time(session: Session, by_s: float) -> None:
    raw = session.raw()
    if hasattr(raw, "data"):
        raw.data.time += by_s


def machine(row: Row) -> dict[tuple[str, str], Cell]:
    """The cells of a row."""
    cells: dict[tuple[str, str], Cell] = {}
    for what in _PARTS:
        for factor in (1.0 - _WRONG, 1.0 + _WRONG):
            cells[f"{what} 20 % wrong", f"times {factor:g}"] = _plant(what, factor)(row)
    cells["delay 20 % wrong", ""] = _late(row)
    cells["sensor silent", ""] = _silent(row)
    cells["clock set back", ""] = _clock(-_SET_S)(row)
    cells["clock set forward", ""] = _clock(_SET_S)(row)
    return cells
