"""Random MuJoCo models through MujocoPlant and a filter: supported, or refused by name, never a crash.

    python -m benchmarks random_models              # 10,000 models; goes on where it was stopped
    python -m benchmarks random_models --seed 17    # one of them: its XML, and what became of it

A model that MuJoCo compiles and can simulate becomes one of Gymnasium's MuJoCo envs, twice: one is filtered, the twin
gets what was executed. It is *supported* if every forecast of an executed control is the env's step and the twin's to
the last bit (to 0.001 where bodies may sleep, which MuJoCo's state does not tell), every executed control is finite
and in the action space, and f + g u is MuJoCo's acceleration where no constraint is active. It is *refused* if the
library says so and names the part of the model. Everything else is a *defect*: another exception, a crash, more than
two minutes, a number that is wrong. Models run in a process of their own, so that a crash is seen and has a seed; a
crash of MuJoCo alone, before the library is asked, counts as refused by MuJoCo. A defect that was found is tried
again when the command is.
"""

import copy
import itertools
import json
import multiprocessing
import os
import random
import re
import tempfile
import traceback
import warnings
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv

import safe_wrappers as sw
from benchmarks.random_mjcf import RandomModel
from benchmarks.tables import RESULTS, keep, markdown, options
from safe_wrappers.errors import SafeWrappersError
from safe_wrappers.plants.mujoco.model import inertia

STEPS = 3
LONGEST_S = 120.0
"""Of one model, the first one's imports and compilation included."""
_FULL = mujoco.mjtState.mjSTATE_FULLPHYSICS
_HINGE_OR_SLIDE = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
_READ = ("qpos", "qvel", "act", "qacc", "ctrl", "xpos", "xipos", "qfrc_actuator", "cfrc_ext", "mocap_pos")


class Machine(MujocoEnv):
    """Any MJCF as one of Gymnasium's MuJoCo envs; actions are the controls."""

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - Gymnasium's

    def __init__(self, model: mujoco.MjModel, frame_skip: int, dtype: type) -> None:
        self._made, self._dtype = model, dtype
        super().__init__(__file__, frame_skip, gym.spaces.Box(-np.inf, np.inf, (1,)))

    def _initialize_simulation(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        return self._made, mujoco.MjData(self._made)

    def _set_action_space(self) -> gym.spaces.Box:
        limited, bounds = self.model.actuator_ctrllimited == 1, self.model.actuator_ctrlrange
        low, high = np.where(limited, bounds.T, [[-np.inf], [np.inf]])
        self.action_space = gym.spaces.Box(
            low.astype(self._dtype), high.astype(self._dtype), dtype=self._dtype
        )
        return self.action_space

    def reset_model(self) -> Any:
        draw, model = self.np_random, self.model
        qpos = self.init_qpos.copy()
        mujoco.mj_integratePos(model, qpos, draw.normal(0.0, 0.3, model.nv), 1.0)
        self.data.mocap_pos += draw.normal(0.0, 0.1, (model.nmocap, 3))
        self.set_state(qpos, draw.normal(0.0, 0.5, model.nv))
        return np.zeros(1, np.float32)

    def step(self, action: Any) -> Any:
        self.do_simulation(action, self.frame_skip)
        return np.zeros(1, np.float32), 0.0, False, False, {}


class DefectError(Exception):
    """What the library did is wrong."""


def _made(seed: int) -> tuple[Machine, Machine, random.Random]:
    """The machine and its twin."""
    rng = random.Random(f"trial {seed}")
    frame_skip, dtype = rng.choice((1, 2, 4, 5)), rng.choice((np.float32, np.float64))
    model = mujoco.MjModel.from_xml_string(RandomModel(seed).xml)
    return *(Machine(each, frame_skip, dtype) for each in (model, copy.copy(model))), rng  # type: ignore[return-value]


def simulates(seed: int) -> tuple[str, str]:
    """Whether MuJoCo alone compiles and simulates a model: "mujoco" and why not, or nothing."""
    try:
        _simulate(_made(seed)[1], seed)
    except (ValueError, mujoco.FatalError) as error:
        return "mujoco", str(error)
    return "", ""


def trial(seed: int) -> tuple[str, str]:
    """What became of a model that MuJoCo simulates: "supported", "refused" or "defect", and why."""
    machine, twin, rng = _made(seed)
    _simulate(twin, seed)
    try:
        _closed_loop(machine, twin, seed, rng)
    except SafeWrappersError as error:
        return ("refused" if _names_a_part(str(error), machine.model) else "defect"), str(error)
    except Exception:
        return "defect", traceback.format_exc()
    return "supported", ""


def _simulate(env: Machine, seed: int) -> None:
    env.reset(seed=seed)
    for _ in range(STEPS):
        env.step(np.clip(np.zeros_like(env.action_space.low), env.action_space.low, env.action_space.high))


def _names_a_part(message: str, model: mujoco.MjModel) -> bool:
    """Whether a refusal says which part of the model is not supported."""
    kinds = ("body", "jnt", "geom", "site", "tendon", "eq")
    counts = {"actuator": "nu", **{kind: f"n{kind}" for kind in kinds}}
    names = [getattr(model, kind)(i).name for kind, n in counts.items() for i in range(getattr(model, n))]
    named = any(re.search(rf"\b{re.escape(name)}\b", message) for name in names if name)
    return named or bool(re.search(r"'#\d+'|no actuator|the model's \w+ (is|are)", message))


def _closed_loop(machine: Machine, twin: Machine, seed: int, rng: random.Random) -> None:
    onlooker = sw.MujocoPlant()
    onlooker.bind(machine)
    plants = {} if rng.random() < 0.8 else {"delay_s": 0.013}
    env = _filtered(machine, plants, rng)
    env.reset(seed=seed)
    twin.reset(seed=seed)
    for _ in range(STEPS):
        onlooker.observe()
        proposed = _proposal(machine.action_space, rng)
        *_, info = env.step(proposed)
        executed = info["executed_action"]
        inside = machine.action_space.contains(executed.astype(proposed.dtype))
        if not (inside and np.isfinite(executed).all()):
            raise DefectError(f"executed {executed} of {machine.action_space}")
        _check_forecast(onlooker, machine, executed)
        twin.step(executed.astype(proposed.dtype))
        _check_twin(machine, twin)
        onlooker.observe()
        if np.isfinite(onlooker.state).all():
            _check_response(onlooker, rng)
            _ask(onlooker, executed)


def _filtered(machine: Machine, plants: dict[str, Any], rng: random.Random) -> gym.Env[Any, Any]:
    """The machine with a filter of the first constraint that fits."""
    model, limits, unfit = machine.model, sw.constraints, []
    joints = [model.joint(j) for j in range(model.njnt) if model.jnt_type[j] in _HINGE_OR_SLIDE]
    scalar = [joint.name for joint in joints if joint.name]
    body = model.body(model.nbody - 1).name
    some = rng.sample(scalar, min(2, len(scalar)))
    options = [
        limits.SpeedLimit(rng.uniform(0.05, 2.0), body=rng.choice((None, body))),
        limits.Workspace(low=[-1.0, None, 0.0], high=[1.0, 1.0, None], bodies=[body], horizon=2),
        limits.Clearance([limits.Plane([0.5, 0.0, 0.0], [-1.0, 0.0, 0.0])], 3.0, bodies=[body]),
    ]
    if some:
        options += [limits.JointPositionLimit(-0.5, 0.5, some), limits.JointPositionLimit(joints=some)]
    rng.shuffle(options)
    speed = rng.uniform(0.05, 2.0)
    first = [limits.JointSpeedLimit(speed), *([limits.JointSpeedLimit(speed, some)] if some else [])]
    for constraint in [*(first if rng.random() < 0.6 else []), *options]:
        also = [options[0]] if rng.random() < 0.2 and constraint is not options[0] else []
        try:
            return sw.CBFActionFilter(machine, [constraint, *also], sw.MujocoPlant(**plants))
        except SafeWrappersError as error:
            if not _names_a_part(str(error), model):
                raise
            unfit.append(str(error))
    raise DefectError(f"no constraint fits: {unfit}")


def _proposal(space: gym.spaces.Box, rng: random.Random) -> Any:
    """Anything that a policy may propose: inside, at a corner, outside, not finite."""
    low, high = np.maximum(space.low, -3.0), np.minimum(space.high, 3.0)
    draw = np.random.default_rng(rng.getrandbits(32))
    inside = low + (high - low) * draw.random(low.shape)
    kind = rng.random()
    if kind < 0.2:
        inside = np.where(draw.random(low.shape) < 0.5, low, high)
    elif kind < 0.3:
        inside = 3.0 * inside + 1.0
    elif kind < 0.35:
        inside = inside * np.nan
    return inside.astype(space.dtype)


def _check_forecast(onlooker: sw.MujocoPlant, machine: Machine, executed: Any) -> None:
    """The forecast from the state before the step is where the env is now, bit for bit."""
    end = onlooker.rollout(executed).states[-1]
    reached = np.concatenate([machine.data.qpos, machine.data.qvel])
    was_reset = machine.data.warning.number[mujoco.mjtWarning.mjWARN_BADQPOS :].any() and np.isnan(end).all()
    sleeps = machine.model.opt.enableflags & int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    rounding = 1e-3 if sleeps else 0.0  # MuJoCo's state does not say who sleeps
    if not (was_reset or np.allclose(end, reached, rtol=0.0, atol=rounding, equal_nan=True)):
        raise DefectError(f"the forecast is {np.abs(end - reached).max():.3g} away from the env")


def _check_twin(machine: Machine, twin: Machine) -> None:
    """The filtered env is where an env is that was given the executed action, bit for bit."""
    states = [np.zeros(mujoco.mj_stateSize(m.model, _FULL)) for m in (machine, twin)]
    for m, state in zip((machine, twin), states, strict=True):
        mujoco.mj_getState(m.model, m.data, state, _FULL)
    differ = [n for n in _READ if getattr(machine.data, n).tobytes() != getattr(twin.data, n).tobytes()]
    if states[0].tobytes() != states[1].tobytes() or differ:
        raise DefectError(f"the filtered env is elsewhere than its twin; they differ in {differ}")


def _check_response(onlooker: sw.MujocoPlant, rng: random.Random) -> None:
    """Without active constraints f + g u is what MuJoCo says."""
    drift, effect = onlooker.acceleration
    data = onlooker.forward()
    if data.nefc or not np.isfinite(effect).all():
        if not np.isfinite(effect).all():
            raise DefectError("g is not finite")
        return
    low, high = onlooker.actuators.acting_range(data.actuator_length, data.actuator_velocity)
    low = np.maximum(low, np.minimum(high, 3.0) - 6.0)
    high = np.minimum(high, low + 6.0)
    control = low + rng.random() * (high - low)
    expected = onlooker.under(control)
    if expected.nefc:
        return
    size = 1.0 + np.abs(expected.qacc).max(initial=0.0) + np.abs(effect * control).max(initial=0.0)
    missed = np.abs(drift + effect @ control - expected.qacc).max(initial=0.0)
    if not missed <= 1e-7 * size:
        raise DefectError(f"f + g u is {missed:.3g} away from an acceleration of {size - 1.0:.3g}")


def _ask(onlooker: sw.MujocoPlant, executed: Any) -> None:
    """Whatever else constraints may ask a plant."""
    body = onlooker.model.body(onlooker.model.nbody - 1).name
    longer = onlooker.rollout(executed, 3)
    asked: dict[str, Any] = {
        "f": onlooker.f,
        "g": onlooker.g,
        "inertia": np.diag(inertia(onlooker.model, onlooker.forward())),
        "position": onlooker.motion("body", body)[0],
        "braking": onlooker.braking(),
        "substep_ago": onlooker.substep_ago().frames,
        "poses": longer.poses().centres if np.isfinite(longer.states).all() else 0.0,
        "point": onlooker.point("body", body)[3],
    }
    onlooker.sketch(executed, 2)
    onlooker.contact_forecast(executed)
    for what, found in asked.items():
        if not np.isfinite(found).all():
            raise DefectError(f"{what} is not finite at a finite state")


def _begin() -> None:
    os.chdir(tempfile.mkdtemp())  # MuJoCo writes its log into the working directory
    warnings.simplefilter("ignore")
    warnings.filterwarnings("error", category=RuntimeWarning, module="safe_wrappers")


def outcomes(seeds: Iterable[int]) -> Iterator[tuple[int, str, str]]:
    """Seed, outcome and reason of each seed, in a process that may crash or hang and is made anew then."""
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(1, context, initializer=_begin)
    for seed in seeds:
        found = ("mujoco", "MuJoCo alone crashes or hangs")
        try:
            found = pool.submit(simulates, seed).result(LONGEST_S) or found
            if not found[0]:
                found = ("defect", "the interpreter crashed, or hung")
                found = pool.submit(trial, seed).result(LONGEST_S)
        except (BrokenProcessPool, TimeoutError):
            for process in pool._processes.values():
                process.kill()
            pool = ProcessPoolExecutor(1, context, initializer=_begin)
        yield seed, *found
    pool.shutdown()


def kind_of(refusal: str) -> str:
    """A refusal without the names and numbers of one model."""
    first = refusal.partition("Use AnalyticPlant")[0].partition("Covered would be")[0]
    for more in ("; the model has", " ('", ", which", " (actuatorgroupdisable"):
        first = first.partition(more)[0]
    plain = re.sub(r"<[^>]* object at \w+>", "the env", first)
    return re.sub(r"'[^']*'", "'...'", re.sub(r"-?\d[\d.e+-]*", "N", plain))[:140].strip()


def main() -> None:
    """Count until there are so many models, and keep the counts as they come; print the table."""
    given = options(__doc__, models=10_000, seed=int)
    if given.seed is not None:
        print(RandomModel(given.seed).xml, *next(outcomes([given.seed])), sep="\n")
        return
    path = RESULTS / "random_models.json"
    new = {"next_seed": 0, "mujoco": 0, "supported": 0, "refused": {}, "defects": []}
    counts: dict[str, Any] = json.loads(path.read_text()) if path.exists() else new
    again = [defect["seed"] for defect in counts["defects"]]  # they may have been mended
    counts["defects"] = []
    for seed, outcome, why in outcomes(itertools.chain(again, itertools.count(counts["next_seed"]))):
        if outcome == "defect":
            counts["defects"].append({"seed": seed, "why": why})
        elif outcome == "refused":
            counts["refused"][kind_of(why)] = counts["refused"].get(kind_of(why), 0) + 1
        else:
            counts[outcome] += 1
        counts["next_seed"] = max(counts["next_seed"], seed + 1)
        path.write_text(json.dumps(counts, indent=1) + "\n")
        if counts["supported"] + sum(counts["refused"].values()) + len(counts["defects"]) >= given.models:
            break
    keep("random_models", table(counts))


def table(counts: dict[str, Any]) -> str:
    """Markdown: what became of the models."""
    refused = sorted(counts["refused"].items(), key=lambda item: -item[1])
    rows = [("supported", counts["supported"]), *((f"refused: {kind}", count) for kind, count in refused)]
    rows += [("defect", len(counts["defects"])), ("(refused by MuJoCo itself)", counts["mujoco"])]
    return markdown("outcome | models", ([name, f"{count:,}"] for name, count in rows))
