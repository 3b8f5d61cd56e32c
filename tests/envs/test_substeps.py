"""What info says of a control step, against judges of their own that see the state after every physics substep."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from flexible_joint import vibration_energy

from safe_wrappers.envs.flex_joint_reach import SPRINGS, TORQUE_RATING
from safe_wrappers.envs.teleop_contact import CLAMP_Y, TOOL_RADIUS

State = tuple[np.ndarray, np.ndarray]  # qpos, qvel
Judge = Callable[[list[State], np.ndarray], tuple[list[bool], dict[str, float]]]


class Drive(NamedTuple):
    """A drive that meets limits: `act(env, rng, step)`, and a judge of each episode's states."""

    act: Callable[[Any, np.random.Generator, int], np.ndarray]
    judge: Callable[[Any], Judge]
    """It says of each state whether it costs, and what else info must hold, by key."""
    steps: int
    episode: int
    layout: dict[str, Any] = {}  # noqa: RUF012 (never changed)


def to_things(env, rng, step):
    """Straight at hazards and vases in turn, so that edges are crossed often."""
    things = np.concatenate([env.hazard_positions, env.vase_positions])
    if env.robot.name == "car":
        things = things[np.argsort(np.linalg.norm(things - env.agent_position, axis=1))[:5]]
    offset = things[step // 30 % len(things)] - env.agent_position
    bearing = math.remainder(math.atan2(offset[1], offset[0]) - env.agent_heading, math.tau)
    if env.robot.name == "car":  # the wheel named left is on the heading's right
        return np.clip([1.0 + 2.0 * bearing, 1.0 - 2.0 * bearing], -1.0, 1.0) * 0.02
    return np.clip(np.array([math.cos(bearing), bearing]) + rng.normal(0, 0.3, 2), -1, 1)


def of_goals(env):
    """Centre in a hazard; at level 2 a vase touched or moving, from contacts that are computed afresh."""
    model, fresh = env.model, mujoco.MjData(env.model)
    parts = {"point": ["agent"], "car": ["agent", "left", "right", "rear"]}[env.robot.name]
    robot = [model.body(part).id for part in parts]
    vases = [model.body(f"vase{i}").id for i in range(env.level.vases)]

    def hit(qpos, qvel):
        fresh.qpos[:], fresh.qvel[:] = qpos, qvel
        mujoco.mj_fwdPosition(model, fresh)
        bodies = model.geom_bodyid[fresh.contact.geom]
        touched = (np.isin(bodies, robot) & np.isin(bodies, vases)[:, ::-1]).any()
        speeds = [np.linalg.norm(qvel[at : at + 3]) for at in model.body_dofadr[vases]]
        return env.level.vases_cost and bool(touched or max(speeds) > 1e-4)

    def judge(states, action):
        inside = [bool((np.hypot(*(qpos[:2] - env.hazard_positions).T) <= 0.2).any()) for qpos, _ in states]
        hits = [hit(*state) for state in states]
        last = {"cost": inside[-1] or hits[-1], "cost_hazards": inside[-1], "cost_vases": hits[-1]}
        return [a or b for a, b in zip(inside, hits, strict=True)], last

    return judge


def of_rover(env):
    def judge(states, action):
        apart = [np.hypot(*(qpos[:2] - env.hazard_positions).T).min() for qpos, _ in states]
        astray = []
        for qpos, qvel in states:
            w, x, y, z = qpos[3:7]
            heading = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
            speed = qvel[:2] @ [math.cos(heading), math.sin(heading)]
            astray.append(abs(qvel[5] - speed * math.tan(0.5 * (qpos[7] + qpos[9])) / 0.5))
        return [gap <= 0.3 for gap in apart], {"yaw_rate_error": max(astray)}

    return judge


def of_crossing(env):
    """An overlap that begins is a collision."""
    lanes = np.repeat([-0.8, 0.8], 3)

    def touching(qpos):
        return np.hypot(qpos[3:9] - qpos[0], lanes - qpos[1]) <= 0.6

    was = np.zeros(6, dtype=bool)

    def judge(states, action):
        nonlocal was
        now = [touching(qpos) for qpos, _ in states]
        begun = sum(int((b & ~a).sum()) for a, b in zip([was, *now], now, strict=False))
        was = now[-1]
        return [bool(one.any()) for one in now], {"collisions": begun}

    return judge


def of_arm(env):
    def judge(states, action):
        torque = np.clip(np.asarray(action, float), [-3, -1], [3, 1])  # beyond the bounds the motors clip
        deflections = np.abs([qpos[SPRINGS] for qpos, _ in states])
        energies = [vibration_energy(env.arm, *state, torque) for state in states]
        over = (deflections * env.arm.stiffness > TORQUE_RATING).any(axis=1)
        return over.tolist(), {"vibration_energy": max(energies), "deflection": deflections.max()}

    return judge


def of_tool(env):
    def judge(states, action):
        gaps = [CLAMP_Y - TOOL_RADIUS - qpos[1] for qpos, _ in states]
        return [gap <= 0.0 for gap in gaps], {"clearance": gaps[-1]}

    return judge


def held(low, high, steps):
    """Random actions, each for some steps."""
    return lambda env, rng, step: np.random.default_rng(step // steps).uniform(low, high)


FAST = [[-4.0, 25.0], [-9.0, 15.0], [-2.5, 2.0], [6.0, -30.0], [8.0, -10.0], [60.0, 0.0]]
DRIVES = {
    **{f"SafePointGoal{level}-v0": Drive(to_things, of_goals, 150 + 150 * level, 150) for level in (1, 2)},
    **{f"SafeCarGoal{level}-v0": Drive(to_things, of_goals, 225 * level, 225) for level in (1, 2)},
    "SafeRover-v0": Drive(
        held([-1, -1, -1, -1, -0.3], [1, 1, 1, 1, 0.3], 15), of_rover, 180, 60,
        {"speed": 3.0, "agent": [-2, 0, 0], "hazards": [[-1, 0.28]]},
    ),
    "OccludedCrossing-v0": Drive(
        held([-0.4, -0.2, -1.0], [0.4, 0.8, 1.0], 12), of_crossing, 1200, 120,
        {"agent": [0.0, -1.5, 0.0], "cars": FAST},
    ),
    "FlexJointReach-v0": Drive(held([-4.5, -1.5], [4.5, 1.5], 1), of_arm, 60, 60),
    "TeleopContact-v0": Drive(
        lambda env, rng, step: np.array([0.0, 1.0]), of_tool, 150, 150,
        {"tool": [0.0, CLAMP_Y - TOOL_RADIUS - 0.002]},
    ),
}  # fmt: skip


STARTS = {
    "SafePointGoal1-v0": {"agent": [0, 0, 0], "hazards": [[0.1, 0.0]], "vases": [[0.22, 0.0]]},
    "SafePointGoal2-v0": {
        "agent": [0, 0, 0],
        "hazards": [],
        "vases": [[0.22, 0.0]],
    },  # the nose's tip is at 0.15
    "OccludedCrossing-v0": {"agent": [0.0, -0.8, 0.0], "cars": [[-0.3, 1.0], [0.3, 1.0], *[[60.0, 0.0]] * 4]},
    "SafeRover-v0": {"agent": [1, 1, 0], "hazards": [[1.2, 1.0]], "speed": 2.0},
}
"""Starts that cost, which reset says."""


@pytest.mark.parametrize("env_id", DRIVES)
def test_costs_count_every_substep(env_id, monkeypatch):
    drive, env = DRIVES[env_id], gym.make(env_id).unwrapped
    name = "mj_step1" if "Rover" in env_id else "mj_step"
    original, starts, seen, met = getattr(mujoco, name), [], set(), set()

    def watched(model, data, *more):
        starts.append((data.qpos.copy(), data.qvel.copy()))
        original(model, data, *more)

    def begin(seed, layout):
        """Resets, and judges the start; returns the judge."""
        info = env.reset(seed=seed, options={"layout": layout} if layout else {})[1]
        judge = drive.judge(env)
        violated = check(info, *judge([(env.data.qpos, env.data.qvel)], np.zeros(env.action_space.shape)))
        return judge, any(violated)

    def check(info, violated, expected):
        expected = {"cost": any(violated), "cost_substep": any(violated)} | expected
        for key, value in expected.items():
            assert info[key] == pytest.approx(float(value), rel=1e-9, abs=1e-12), key
        assert info.get("spin_out") == (float(info["slip_max"] > 0.5) if "slip_max" in info else None)
        return violated

    monkeypatch.setattr(mujoco, name, watched)
    rng = np.random.default_rng(2)
    assert env_id not in STARTS or begin(0, STARTS[env_id])[1]
    for step in range(drive.steps):
        if step % drive.episode == 0:
            judge, _ = begin(step, drive.layout)
        action = drive.act(env, rng, step)
        starts.clear()
        info = env.step(action)[4]
        ends = [*starts[1 : env.frame_skip], (env.data.qpos, env.data.qvel)]
        assert len(ends) == env.frame_skip
        violated, expected = judge(ends, action)
        check(info, violated, expected)
        met.update(key for key in ("cost", "cost_substep", *expected) if info[key])
        seen.add((any(violated), violated[-1]))
    assert seen == {(False, False), (True, True)} | ({(True, False)} if env.frame_skip > 1 else set())
    nothing = {"cost_vases"} if "Goal1" in env_id else set()  # where they cost nothing
    assert met == {"cost", "cost_substep", *expected} - nothing


def test_touch_before_the_step_is_not_charged_to_the_step():
    """MuJoCo's contacts lag one substep behind: those of the state before must not count again."""
    env = gym.make("SafePointGoal2-v0").unwrapped
    layout = {"agent": [0, 0, 0], "hazards": [], "vases": [[0.25 - 1e-6, 0.0]]}
    assert env.reset(seed=0, options={"layout": layout})[1]["cost_vases"] == 1.0
    qvel = np.zeros(env.model.nv)
    qvel[0] = -1.0  # leaving: the vase feels no force
    env.set_state(env.data.qpos.copy(), qvel)
    info = env.step(np.zeros(2))[4]
    assert (info["cost"], info["cost_substep"]) == (0.0, 0.0)
