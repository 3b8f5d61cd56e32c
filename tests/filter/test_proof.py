"""The proof of docs/concepts/how-it-works.md, step by step, on models of every kind, judged by each env's own truth.

From a drawn state that is safe the backup is admitted; whatever is proposed, the executed control is not flagged and
breaks nothing at any physics substep, and the next state is safe again.
"""

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import mujoco
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from oracles import held, to_rest
from scenes import Scene
from simulated_worlds import DT, TOP, WALL, Cart

import safe_wrappers as sw
from benchmarks.cases import CASES
from benchmarks.judges import Replay, Reported
from safe_wrappers.control.backup.damped_axis import damped_axis
from safe_wrappers.plants.plant import Model, Trajectory

ROUNDING = 1e-6  # of float32 actions: `cbf/unsafe` allows as much


class Drawn(NamedTuple):
    """Numbers in [-1, 1] that say where and how a machine moves."""

    ahead: float
    turn: float
    speed: float
    slide: float


END_M = 1.0
SLED = """
<mujoco><option timestep="0.005"/><worldbody><body><joint name="rail" type="slide" axis="1 0 0" damping="0.3"/>
<geom size="0.05" mass="1"/></body></worldbody><actuator><motor joint="rail" ctrlrange="-2 3" ctrllimited="true"/>
</actuator></mujoco>
"""
RAIL = damped_axis(1.0 / (1.0 + 0.005 * 0.3), 0.005 / (1.0 + 0.005 * 0.3), 0.005, 4, -2.0, 3.0)
"""MuJoCo's damping is implicit."""


@dataclass
class EndOfRail(sw.Constraint, Model):
    """A user's own model: MuJoCo's steps of a damped mass, written down, until it rests."""

    promise = "proved"

    def rollout(self, control, horizon=1):
        x, v = self.plant.state.tolist()
        places, held_first = [x], control is not None
        while held_first or abs(v) > 1e-12:
            more, v = held(RAIL, places[-1], v, float(control[0]) if held_first else to_rest(RAIL, v))
            places, held_first = places + more, False
        return Trajectory(control, np.array(places)[:, None])

    def h_along(self, path):
        return END_M - path.states

    def proposals(self, control):
        brake = np.clip([to_rest(RAIL, float(self.plant.state[1]))], RAIL.low, RAIL.high)
        return [brake] if control is None else []


def on_the_rail(raw, drawn):
    raw.data.qpos[:], raw.data.qvel[:] = END_M + 0.3 * (drawn.ahead - 1.0), 2.0 * drawn.speed


def cart_before_a_wall():
    brake = lambda seen: [float(np.clip(-seen[1] / DT, -TOP, TOP))]  # noqa: E731
    rests = lambda seen: abs(seen[1]) < 1e-9 and seen[0] <= WALL  # noqa: E731
    shield = sw.constraints.PredictiveShield(lambda seen: WALL - seen[0], 60, brake, rests)
    return sw.CBFActionFilter(Cart(), [shield], sw.SimulatorPlant())


def in_the_cart(raw, drawn):
    raw.start = WALL + (drawn.ahead - 1.0), 2.0 * drawn.speed
    made("copies of the env")[0].reset()


def beside_a_hazard(raw, drawn):
    """Up to 0.3 m from its edge, with any heading, moving in any direction."""
    qpos, qvel = raw.data.qpos.copy(), raw.data.qvel.copy()
    angle, heading = np.pi * drawn.turn, 5.0 * np.pi * drawn.slide
    hazard = raw.hazard_positions[int(7.99 * abs(drawn.slide))]
    place = hazard + (0.35 + 0.15 * drawn.ahead) * np.array([np.cos(angle), np.sin(angle)])
    qpos[:2] += place - raw.agent_position
    if raw.model.jnt_type[0] == int(mujoco.mjtJoint.mjJNT_FREE):
        qpos[3:7] = np.cos(heading / 2.0), 0.0, 0.0, np.sin(heading / 2.0)
    else:
        qpos[2] = heading
    qvel[:2] = drawn.speed * np.cos(angle + drawn.slide), drawn.speed * np.sin(angle + drawn.slide)
    raw.set_state(qpos, qvel)


def in_the_maze(raw, drawn):
    """Anywhere in the U, its walls included, at up to the speed to which the env clips."""
    raw.point_env.set_state(
        np.array([1.6 * drawn.ahead, 1.6 * drawn.turn]), 5.0 * np.array([drawn.speed, drawn.slide])
    )


def known(env_id, place):
    case = CASES[env_id]
    return lambda: case.protect(case.make()), place, case.judge


KINDS = {
    "a heading drive": known("SafePointGoal1-v0", beside_a_hazard),
    "MuJoCo's model of a car": known("SafeCarGoal1-v0", beside_a_hazard),
    "a point on two axes": known("PointMaze_UMaze-v3", in_the_maze),
    "copies of the env": (
        cart_before_a_wall,
        in_the_cart,
        lambda raw: Reported(lambda info: info["cost"] - 0.5),
    ),
    "a user's own": (
        lambda: sw.CBFActionFilter(Scene(SLED, frame_skip=4), [EndOfRail()]),
        on_the_rail,
        lambda raw: Replay(raw, lambda data: float(data.qpos[0]) - END_M - ROUNDING),
    ),
}
"""A filtered env, how to put its machine somewhere, and who judges it."""


@cache
def made(kind):
    make, _, judge = KINDS[kind]
    env = make()
    env.reset(seed=0)
    found = env
    while not isinstance(found, sw.CBFActionFilter):
        found = found.env
    return env, found, judge(env.unwrapped)


number = st.floats(-1.0, 1.0, width=32)
HALVINGS = 12


def begin(kind, drawn):
    """Put the machine there: h of its way to rest, infinite where nothing is near."""
    env, flt, _ = made(kind)
    KINDS[kind][1](env.unwrapped, drawn)
    flt.filter.start()
    (bound,) = flt.filter.bound
    # A shield's h is that of the present state: its way to rest is the backup's plan.
    lost = kind == "copies of the env" and not bound.admits(bound.backup())
    return -np.inf if lost else bound.least


def near_the_boundary(kind, drawn, other):
    """Begin in a safe state on the line between two, next to an unsafe one if there is one; whether there is any."""
    ends = sorted((begin(kind, drawn._replace(ahead=one)) > ROUNDING, one) for one in (drawn.ahead, other))
    (is_safe, unsafe), (found, safe) = ends
    for _ in range(0 if is_safe or not found else HALVINGS):
        middle = (unsafe + safe) / 2
        safe, unsafe = (
            (middle, unsafe) if begin(kind, drawn._replace(ahead=middle)) > ROUNDING else (safe, middle)
        )
    return begin(kind, drawn._replace(ahead=safe)) > ROUNDING


@pytest.mark.parametrize("kind", KINDS)
@given(
    st.builds(Drawn, number, number, number, number),
    number,
    st.lists(st.one_of(st.sampled_from([-1.0, 1.0]), number), min_size=8, max_size=8),
)
def test_from_a_safe_state_every_step_is_safe_and_leads_to_a_safe_state(kind, drawn, other, asked):
    env, flt, judge = made(kind)
    env.reset(seed=0)
    assume(near_the_boundary(kind, drawn, other))
    assert [b.spec.promise for b in flt.filter.bound] == ["proved"]
    space = env.action_space
    for share in np.array(asked).reshape(4, -1)[:, : space.shape[0]]:
        (bound,) = flt.look()
        backup = bound.backup()
        assert backup is not None and bound.admits(backup)
        middle, half = (space.high + space.low) / 2, (space.high - space.low) / 2
        judge.before()
        _, _, ended, cut, info = env.step((middle + half * share).astype(space.dtype))
        assert not judge.after(info["executed_action"], info) > 0.0
        assert not (info["cbf/infeasible"] or info["cbf/fallback"] or info["cbf/mismatch"])
        if ended or cut:
            return
        assert flt.look()[0].least >= -ROUNDING
