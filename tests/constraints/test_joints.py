"""Limits on all joints: what an action moves without an actuator on the joint is not left out in silence."""

import re

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from asking import Asked, bound
from gymnasium.envs.mujoco import MujocoEnv
from judged_loops import DRIVERS, Judge, check_inactive, drive, flagged

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError

LIMITS = {
    "JointSpeedLimit": lambda **more: sw.constraints.JointSpeedLimit(3.0, **more),
    "JointPositionLimit": lambda **more: sw.constraints.JointPositionLimit(-7.0, 7.0, horizon=1, **more),
}


def listed(error):
    """Both lists of the message."""
    found = re.search(r"Covered would be: (.*)\. Not covered: (.*?)\. ", str(error.value))
    return [part.split(", ") for part in found.groups()]


def fetch(env_id):
    gym.register_envs(pytest.importorskip("gymnasium_robotics"))
    return gym.make(env_id)


@pytest.mark.parametrize("limit", LIMITS)
def test_an_arm_that_is_pulled_by_its_hand_is_not_left_out(limit):
    env = fetch("FetchPickAndPlace-v4")
    with pytest.raises(ConfigurationError, match=r"Name those that you mean: joints=\['robot0:") as caught:
        sw.CBFActionFilter(env, [LIMITS[limit]()])
    covered, rest = listed(caught)
    assert sorted(covered) == ["robot0:l_gripper_finger_joint", "robot0:r_gripper_finger_joint"]
    assert {"robot0:shoulder_pan_joint", "robot0:wrist_roll_joint"} <= set(rest) and len(rest) == 13
    for named in (rest, covered, covered + rest):
        filtered = sw.CBFActionFilter(fetch("FetchPickAndPlace-v4"), [LIMITS[limit](joints=named)])
        assert filtered.constraints[0].joints == named


@pytest.mark.parametrize(
    ("env_id", "covered", "rest"),
    [
        ("SafePointGoal0-v0", {"z"}, {"x", "y"}),  # pushed at a site
        (
            "SafeRover-v0",
            {"front_left", "front_right", "rear_left", "rear_right"},
            {"steer_left", "steer_right"},
        ),
    ],
)
def test_sites_and_tendons_move_joints_too(env_id, covered, rest):
    with pytest.raises(ConfigurationError) as caught:
        sw.CBFActionFilter(gym.make(env_id), [sw.constraints.JointSpeedLimit(3.0)])
    assert [set(names) for names in listed(caught)] == [covered, rest]


LINKAGE = """
<mujoco><compiler autolimits="true"/><worldbody>
  <body><joint name="crank" axis="0 1 0"/><geom type="capsule" size=".02" fromto="0 0 0 .2 0 0" mass="1"/>
    <site name="tip" pos=".2 0 0"/>
    <body pos=".2 0 0"><joint name="rod" axis="0 1 0"/><geom size=".03" mass="1"/><site name="end"/></body></body>
  <body name="other" pos="0 1 0"><joint name="rocker" axis="0 1 0"/><geom size=".05" mass="1"/>
    <site name="far" pos=".1 0 0"/></body>
  <body pos="0 2 0"><joint name="loose" axis="0 1 0"/><geom size=".05" mass="1" pos=".1 0 0"/></body>
</worldbody>
<tendon><spatial name="cable" {cable}><site site="tip"/><site site="far"/></spatial>
  <fixed name="one"><joint joint="crank" coef="1"/></fixed><fixed name="two"><joint joint="rod" coef="1"/></fixed>
</tendon>
<equality>{equality}</equality>
<actuator><motor joint="crank" ctrlrange="-1 1"/></actuator></mujoco>
"""
TIES = [
    ('<joint joint1="rocker" joint2="crank"/>', "", True),
    ('<tendon tendon1="one" tendon2="two"/>', "", True),
    ('<connect site1="end" site2="far"/>', "", True),
    ('<joint joint1="rocker" joint2="crank" active="false"/>', "", False),
    ("", 'range="0 2"', True),
    ("", 'stiffness="10"', True),
    ("", "", False),
]


@pytest.mark.parametrize(("equality", "cable", "tied"), TIES)
def test_joints_that_are_tied_to_driven_ones_are_not_left_out(tmp_path, equality, cable, tied):
    path = tmp_path / "linkage.xml"
    path.write_text(LINKAGE.format(equality=equality, cable=cable))
    if not tied:
        assert sw.CBFActionFilter(Leg(path), [sw.constraints.JointSpeedLimit(3.0)])
        return
    with pytest.raises(ConfigurationError) as caught:
        sw.CBFActionFilter(Leg(path), [sw.constraints.JointSpeedLimit(3.0)])
    assert listed(caught) == [["crank"], ["rod", "rocker", "loose"]]
    assert str(caught.value).endswith("joints=['crank', 'rod', 'rocker', 'loose']")


class Leg(MujocoEnv):
    """A trunk on a leg; the ankle's actuator is not on a hinge."""

    metadata = {"render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"], "render_fps": 100}  # noqa: RUF012

    def __init__(self, path):
        space = gym.spaces.Box(-np.inf, np.inf, (1,))
        super().__init__(str(path), 5, space)

    def reset_model(self):
        return np.zeros(1)

    def step(self, action):
        self.do_simulation(action, self.frame_skip)
        return np.zeros(1), 0.0, False, False, {}


# JointSpeedLimit: adversarial closed loops judged at every physics substep on the env's own data


LEG = """
<mujoco><worldbody><geom type="plane" size="5 5 .1"/><body name="trunk" pos="0 0 .5"><freejoint/>
  <geom size=".1" mass="1"/><body name="leg"><joint name="hip" range="-1 1" limited="true" axis="0 1 0"/>
  <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.4"/><body pos="0 0 -.4">{ankle}
  <geom name="foot" size=".05"/></body></body></body></worldbody>
  <tendon><fixed name="t">{tendon}</fixed></tendon>
  <actuator><motor joint="hip" ctrlrange="-1 1"/>{motor}</actuator></mujoco>
"""

ANKLE = '<joint name="ankle" range="-1 1" limited="true" axis="0 1 0"/>'

LEGS = {
    "tendon": (ANKLE, '<joint joint="ankle" coef="1"/>', '<motor tendon="t" ctrlrange="-1 1"/>'),
    "ball": ('<joint name="ankle" type="ball" range="0 1" limited="true"/>', '<joint joint="hip" coef="1"/>',
             '<motor joint="ankle" gear="0 1 0" ctrlrange="-1 1"/>'),
}  # fmt: skip


@pytest.mark.parametrize("kind", LEGS)
def test_stops_that_would_not_be_guarded_are_refused(tmp_path, kind):
    ankle, tendon, motor = LEGS[kind]
    path = tmp_path / "leg.xml"
    path.write_text(LEG.format(ankle=ankle, tendon=tendon, motor=motor))
    with pytest.raises(ConfigurationError, match="joint_tolerance=None leaves all joints alone") as caught:
        sw.WholeBodyFilter(Leg(path))
    assert listed(caught) == [["hip"], ["ankle"]]
    sw.WholeBodyFilter(Leg(path), joint_tolerance=None)
    with pytest.raises(ConfigurationError, match="Name those that you mean") as caught:
        sw.CBFActionFilter(Leg(path), [sw.constraints.JointSpeedLimit(3.0)])
    assert listed(caught) == [["hip"], ["ankle"]]


class SpeedJudge:
    """Sees every mj_step of the env's own data, and keeps the largest speeds."""

    def __init__(self, monkeypatch, env, dofs):
        self.largest = np.zeros(len(dofs))
        self.substeps = 0
        real = mujoco.mj_step

        def watched(model, data, nstep=1):
            for _ in range(nstep):
                real(model, data)
                if data is env.unwrapped.data:
                    self.substeps += 1
                    self.largest = np.maximum(self.largest, np.abs(data.qvel[dofs]))

        monkeypatch.setattr(mujoco, "mj_step", watched)


def pump(env, k, rng):
    v = env.unwrapped.data.qvel[: env.action_space.shape[0]]
    return np.where(v >= 0.0, env.action_space.high, env.action_space.low)


def bang_bang(env, k, rng):
    return np.where(np.random.default_rng(k // 12).normal(size=env.action_space.shape) > 0, 1, -1) * (
        env.action_space.high
    )


def full(env, k, rng):
    return env.action_space.high


def opposed(env, k, rng):
    return env.action_space.high * np.resize([1.0, -1.0], env.action_space.shape)


def at_random(env, k, rng):
    return rng.uniform(env.action_space.low, env.action_space.high)


CASES = {"Reacher-v5": ([0, 1], 4.0, 400), "InvertedPendulum-v5": ([0], 0.5, 250)}


@pytest.mark.parametrize("driver", [pump, bang_bang, full, opposed, at_random], ids=lambda d: d.__name__)
@pytest.mark.parametrize("env_id", CASES)
def test_no_substep_is_too_fast(monkeypatch, env_id, driver):
    dofs, limit, steps = CASES[env_id]
    filtered = sw.CBFActionFilter(gym.make(env_id), [sw.constraints.JointSpeedLimit(limit)])
    judge = SpeedJudge(monkeypatch, filtered, dofs)
    rng = np.random.default_rng(0)
    intervened = infeasible = 0
    for seed in range(2):
        filtered.reset(seed=seed)
        for k in range(steps):
            # InvertedPendulum's episode ends when the pole falls; the cart's limit holds on
            info = filtered.step(driver(filtered, k, rng).astype(np.float32))[4]
            intervened += info["cbf/intervened"]
            infeasible += info["cbf/infeasible"]
    assert judge.substeps == 2 * steps * filtered.unwrapped.frame_skip
    assert intervened > 0
    if env_id == "Reacher-v5" or not infeasible:
        assert infeasible == 0
        assert (judge.largest <= limit + 1e-6).all(), judge.largest
    assert judge.largest.max() > 0.95 * limit  # and it is used to the full


def test_a_margin_is_kept_free_and_covers_a_wrong_mass(monkeypatch):
    env = gym.make("Reacher-v5")
    filtered = sw.CBFActionFilter(env, [sw.constraints.JointSpeedLimit(4.0, margin=0.5)])
    filtered.plant.perturb(mass=1.2, damping=0.8)
    judge = SpeedJudge(monkeypatch, filtered, [0, 1])
    rng = np.random.default_rng(0)
    filtered.reset(seed=0)
    for k in range(400):
        filtered.step(bang_bang(filtered, k, rng).astype(np.float32))
    assert (judge.largest <= 4.0).all()
    assert judge.largest.max() > 3.0


def test_value_and_rows_against_the_plants_own_prediction():
    env = gym.make("Reacher-v5")
    env.reset(seed=0)
    env.unwrapped.set_state(env.unwrapped.data.qpos.copy(), np.array([3.5, -3.0, 0.0, 0.0]))
    plant = bound(env)
    limit = sw.constraints.JointSpeedLimit(4.0, margin=0.1)
    limit = Asked(limit, plant)
    plant.observe()
    np.testing.assert_allclose(limit.value(), [0.5, 1.0])
    rows = limit.rows()
    drift, effect = plant.acceleration
    rng = np.random.default_rng(0)
    for u in rng.uniform(-1, 1, (50, 2)):
        after = plant.qvel[:2] + plant.control_dt * (drift + effect @ u)[:2]
        linear = bool((np.abs(after) <= 3.9).all())
        assert bool((rows.normals @ u <= rows.offsets).all()) == linear


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"limit": 0.0}, "limit must be a finite number > 0 in rad/s or m/s, got 0.0"),
        ({"limit": 4.0, "margin": -0.1}, "margin must be a finite number >= 0 in rad/s or m/s, got -0.1"),
        ({"limit": 4.0, "joints": []}, "joints is a list of names, or None"),
    ],
)
def test_constructor_refuses_nonsense(arguments, message):
    with pytest.raises(ConfigurationError, match=message):
        limit = sw.constraints.JointSpeedLimit(**arguments)
        sw.CBFActionFilter(gym.make("Reacher-v5"), [limit])


# JointPositionLimit: attacked closed loops judged at every substep, ranges, and what is refused


PUSHER_LOW = np.array([-2.2854, -0.5236, -1.5, -2.3213, -1.5, -1.094, -1.5])
PUSHER_HIGH = np.array([1.714602, 1.3963, 1.7, 0.0, 1.5, 0.0, 1.5])
CASES_LIMIT = {
    "Reacher-v5": (
        sw.constraints.JointPositionLimit(-1.5, 1.5, ["joint0", "joint1"], horizon=10),
        [0, 1],
        -1.5,
        1.5,
    ),
    "InvertedPendulum-v5": (
        sw.constraints.JointPositionLimit(-0.2, 0.2, ["slider"], horizon=8),
        [0],
        -0.2,
        0.2,
    ),
    "Pusher-v5": (sw.constraints.JointPositionLimit(horizon=6), np.arange(7), PUSHER_LOW, PUSHER_HIGH),
}


def room_of(dofs, low, high):
    return lambda model, data: np.minimum(data.qpos[dofs] - low, high - data.qpos[dofs])


def check_closed_loop(env_id, driver, steps, seeds, deepest=1e-3):
    limit, dofs, low, high = CASES_LIMIT[env_id]
    filtered = sw.CBFActionFilter(gym.make(env_id, disable_env_checker=True), [limit])
    seen = drive(filtered, room_of(dofs, low, high), driver, steps, seeds)
    assert seen["intervened"] > 0
    # Infeasible steps (too fast to stop within the horizon) may take it out, by a hair.
    assert seen["least"] > -deepest
    assert seen["outside"] <= seen["flagged"] <= 0.4 * seen["steps"]
    return seen


@pytest.mark.parametrize("driver", DRIVERS)
@pytest.mark.parametrize("env_id", CASES_LIMIT)
def test_no_step_that_is_not_flagged_leaves_the_range(env_id, driver):
    seen = check_closed_loop(env_id, driver, 15 if env_id == "Pusher-v5" else 60, [0])
    if env_id == "InvertedPendulum-v5":
        assert seen["flagged"] == seen["outside"] == 0
        assert seen["least"] < 0.1  # half of the rail is used


def test_far_inside_the_actions_pass_bit_for_bit():
    check_inactive("Reacher-v5", sw.constraints.JointPositionLimit(-6.0, 6.0, ["joint0"]), 1.0, 50)


def test_a_start_that_is_too_fast_slows_down():
    filtered = sw.CBFActionFilter(gym.make("Reacher-v5"), [sw.constraints.JointSpeedLimit(4.0)])
    filtered.reset(seed=0)
    raw = filtered.unwrapped
    raw.set_state(raw.data.qpos.copy(), np.array([9.0, -7.0, 0.0, 0.0]))
    speeds = [9.0]
    with pytest.warns(sw.UnsafeStateWarning):
        for _ in range(40):
            filtered.step(np.array([1.0, -1.0], np.float32))
            speeds.append(np.abs(raw.data.qvel[:2]).max())
    assert speeds[-1] <= 4.0 + 1e-6
    assert speeds[1] < speeds[0]


@pytest.mark.parametrize("start", [[1.7, 0.5], [-1.7, -1.65]])
def test_from_outside_it_goes_inwards(start):
    filtered = sw.CBFActionFilter(
        gym.make("Reacher-v5"),
        [sw.constraints.JointPositionLimit(-1.5, 1.5, joints=["joint0", "joint1"], horizon=10)],
    )
    filtered.reset(seed=0)
    raw = filtered.unwrapped
    qpos = raw.data.qpos.copy()
    qpos[:2] = start
    raw.set_state(qpos, np.zeros(4))
    judge = Judge(filtered, room_of([0, 1], -1.5, 1.5))
    rooms = [judge.at(raw.data)]
    with pytest.warns(sw.UnsafeStateWarning):
        for _ in range(60):
            action = np.sign(start).astype(np.float32)  # farther out, if it may
            least, end, _, info = judge.step(filtered, action)
            assert least >= min(rooms[-1], 0.0) - 1e-6 or flagged(info)
            rooms.append(end)
    assert np.argmax(np.array(rooms) > -1e-3) <= 12  # 0.24 s
    assert min(rooms[30:]) >= -1e-6


# Ranges -------------------------------------------------------------------------------------------------------


def value(env, limit, qpos=None):
    plant = bound(env)
    limit = Asked(limit, plant)
    if qpos is not None:
        env.unwrapped.data.qpos[: len(qpos)] = qpos
    plant.observe()
    return limit.value()


def test_one_value_per_bound_that_there_is():
    env = gym.make("Reacher-v5")
    env.reset(seed=0)
    at = [0.5, -1.0]
    # joint0 turns without end, joint1 from -3 to 3
    np.testing.assert_allclose(value(env, sw.constraints.JointPositionLimit(), at), [2.0, 4.0], atol=1e-12)
    np.testing.assert_allclose(
        value(env, sw.constraints.JointPositionLimit(upper=2.0), at), [2.0, 1.5, 3.0], atol=1e-12
    )
    np.testing.assert_allclose(
        value(env, sw.constraints.JointPositionLimit(-2.0, 1.0), at), [2.5, 1.0, 0.5, 2.0]
    )
    each = sw.constraints.JointPositionLimit([-3.0, -1.0], [0.0, np.inf], joints=["joint1", "joint0"])
    np.testing.assert_allclose(value(env, each, at), [2.0, 1.5, 1.0])
    one_sided = sw.constraints.JointPositionLimit(-np.inf, 2.0, joints=["joint0"])
    np.testing.assert_allclose(value(env, one_sided, at), [1.5])


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"lower": np.nan}, ConfigurationError, "lower is a position in rad or m, or one per joint; got nan"),
        (
            {"lower": 2.0, "upper": 1.0},
            ConfigurationError,
            "nothing is left of the range of joint 'joint0': 2 to 1",
        ),
        ({"margin": -1.0}, ConfigurationError, "margin must be a finite number >= 0 in rad or m, got -1.0"),
        (
            {"joints": ["joint0"]},
            ConfigurationError,
            "none of these joints has a range in the model: pass lower",
        ),
    ],
)
def test_nonsense_is_refused(arguments, error, message):
    with pytest.raises(error, match=message):
        sw.CBFActionFilter(gym.make("Reacher-v5"), [sw.constraints.JointPositionLimit(**arguments)])
