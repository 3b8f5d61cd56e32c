"""Lines that protect an env for which there is no recipe: the first of several that work when they are run on it."""

import operator
import os
import warnings
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import gymnasium as gym
import mujoco

from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.plants.env_checks import check_actions
from safe_wrappers.plants.mujoco.model import SCALAR_JOINTS
from safe_wrappers.plants.simulator.simulation import ForkedSimulation

Env = gym.Env[Any, Any]

_PLACES: Final = (
    "{}",
    "physics.{}.ptr",
    "env.physics.{}.ptr",
    "_env.physics.{}.ptr",
    "sim.{}._{}",
    "env.sim.{}._{}",
    "sim.{}",
    "mj_{}",
    "_{}",
    "_mj_{}",
)
"""Attributes of unwrapped envs that hold MuJoCo's model and data, in packages that wrap MuJoCo."""
_GIVEN: Final = {"h": lambda seen: 1.0, "horizon": 2, "backup": "hold"}
"""What the user fills in, while lines are tried."""


class Remedy(NamedTuple):
    """Lines that protect an env, and the text that introduces them."""

    says: str
    code: str
    """Makes the filtered env out of `env`, with this library as `sw`."""
    is_open: bool = False
    """Whether the user has to give h, horizon and backup."""


def remedy_for(env: Any, single: Env) -> Remedy:
    """The first lines that work: a forecast by MuJoCo's model, else a simulation of the env.

    Args:
        env: What is to be filtered. To be tried, some lines reset it, and step it or a copy.
        single: The env itself, or one of a vector env's.

    Raises:
        ConfigurationError: No lines work; the message says why.
    """
    import safe_wrappers

    discrete = isinstance(single.action_space, gym.spaces.Discrete | gym.spaces.MultiDiscrete)
    if not discrete:
        check_actions(single)
    vector = "Vector" if isinstance(env, gym.vector.VectorEnv) else ""
    kind = "ActionShield" if discrete else f"{vector}CBFActionFilter"
    refused: Exception | None = None
    for remedy in _candidates(single, kind):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                exec(remedy.code, {"env": env, "sw": safe_wrappers, **_GIVEN})
            except Exception as error:  # whatever the step of an env raises that cannot be copied
                refused = error
            else:
                return remedy
    assert refused is not None
    if isinstance(refused, ConfigurationError):
        raise refused
    raise UnsupportedEnvError(f"{type(refused).__name__}: {refused}") from refused


def _candidates(env: Env, kind: str) -> Iterator[Remedy]:
    if isinstance(env.action_space, gym.spaces.Box):
        yield from _limiting_joints(env, kind)
    yield _simulating(kind, "")
    if hasattr(os, "fork"):
        yield _simulating(kind, 'sw.SimulatorPlant("fork")')


def _simulating(kind: str, plant: str) -> Remedy:
    return Remedy(
        "It can be simulated. Say by h(observation) what must stay positive, by backup(observation) which action "
        "keeps it so, and by horizon how many steps to look ahead; then these lines protect it",
        _lines("shield", "sw.constraints.PredictiveShield(h, horizon, backup)", kind, plant),
        is_open=True,
    )


def _limiting_joints(env: Env, kind: str) -> Iterator[Remedy]:
    """Limits of the driven joints, or else of all joints that have a name, where MuJoCo's model can be found."""
    raw: Any = env.unwrapped
    place = next((place for place in _PLACES if _is_there(raw, place)), None)
    if place is None:
        return
    model: mujoco.MjModel = operator.attrgetter(_at(place, "model"))(raw)
    plants = [""]
    if place != _PLACES[0]:
        found = [f"{name}=lambda env: env.{_at(place, name)}" for name in ("model", "data")]
        plants = [f"sw.MujocoPlant({', '.join(found)})"]
        control_dt = _step_length(env, place)
        if control_dt is not None:
            plants.append(f"sw.MujocoPlant({', '.join(found)}, control_dt={control_dt})")
    names = [model.joint(j).name for j in range(model.njnt) if model.jnt_type[j] in SCALAR_JOINTS]
    joints = ["", f", joints={names}"] if names and "" not in names else [""]
    for plant in plants:
        for chosen in joints:
            limit = f"sw.constraints.JointSpeedLimit(limit=4.0{chosen})  # rad/s, m/s; or another constraint"
            yield Remedy("These lines protect it", _lines("limit", limit, kind, plant))


def _at(place: str, name: str) -> str:
    return place.format(name, name)


def _is_there(raw: Any, place: str) -> bool:
    kinds = {"model": mujoco.MjModel, "data": mujoco.MjData}
    try:
        return all(
            isinstance(operator.attrgetter(_at(place, name))(raw), kind) for name, kind in kinds.items()
        )
    except Exception:  # a property of another package's class
        return False


def _step_length(env: Env, place: str) -> float | None:
    """How long the env holds an action, s, by MuJoCo's clock in a child process; None where there is none."""

    def measured(child: Env) -> float:
        child.reset(seed=0)
        data: mujoco.MjData = operator.attrgetter(_at(place, "data"))(child.unwrapped)
        before = data.time
        child.step(child.action_space.sample())
        data = operator.attrgetter(_at(place, "data"))(child.unwrapped)
        return round(float(data.time - before), 9)

    try:
        found = ForkedSimulation(env).run(measured)
    except Exception:  # the trial of the lines tells what is wrong
        return None
    return found if found > 0.0 else None


def _lines(name: str, constraint: str, kind: str, plant: str) -> str:
    lines = [f"{name} = {constraint}"]
    if plant:
        lines.append(f"plant = {plant}")
    lines.append(f"env = sw.{kind}(env, [{name}]{', plant=plant' if plant else ''})")
    return "\n".join(lines)
