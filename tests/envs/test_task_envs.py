"""What every env that the package registers promises: Gymnasium's contract, layouts, goals, refusals, frames."""

import copy
import itertools
import math
import pickle
import subprocess
import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest
from episodes import plain
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env

from safe_wrappers.envs import goal_env, safe_rover
from safe_wrappers.envs.layout import place_goal_beside, place_objects
from safe_wrappers.errors import ActionError, ConfigurationError, SafeWrappersError, UnknownNameError

TASKS = [
    (env_id, {}) for env_id, spec in gym.registry.items() if "safe_wrappers.envs" in str(spec.entry_point)
]
TASKS += [("SafeHopperVelocity-v0", {"version": "v4", "reset_noise_scale": 0.02})]
every_task = pytest.mark.parametrize(("env_id", "options"), TASKS, ids=str)
# Said of every env with unbounded sensors or of forces, Gymnasium's own MuJoCo envs included.
USUAL = ".*(A Box observation space (minimum|maximum) value is -?infinity|a symmetric and normalized space)"


def made(env_id, options):
    if "Maze" in env_id:
        pytest.importorskip("gymnasium_robotics")
    return gym.make(env_id, **options)


@every_task
def test_check_env_passes_without_warnings(env_id, options):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=USUAL)
        check_env(made(env_id, options).unwrapped, skip_render_check=True)


def episode(env, seed, actions):
    return [plain(env.reset(seed=seed)), *(plain(env.step(action)) for action in actions)]


@every_task
def test_the_same_seed_is_the_same_episode_in_every_copy(env_id, options):
    env = made(env_id, options)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(20)]
    first = episode(env, 9, actions)
    copies = (
        env,  # in the middle of an episode
        gym.make(EnvSpec.from_json(env.spec.to_json())),
        pickle.loads(pickle.dumps(env)),
        copy.deepcopy(env),
    )
    for again in copies:
        assert type(again.unwrapped) is type(env.unwrapped)
        assert episode(again, 9, actions) == first
    other, unseeded = plain(env.reset(seed=10)), plain(env.reset())
    assert first[0] != other != unseeded  # the next episode, not the same again


@every_task
def test_info_has_the_same_keys_and_types_at_every_step_and_in_a_vector_env(env_id, options):
    env = made(env_id, options)
    infos = [env.reset(seed=0)[1]]
    env.action_space.seed(0)
    infos += [env.step(env.action_space.sample())[4] for _ in range(20)]
    added = {key for key in infos[0] if "Velocity" not in env_id or key in ("cost", "cost_substep", "speed")}
    types = [{key: type(info[key]) for key in added} for info in infos]
    assert all(one == types[0] for one in types)
    envs = gym.vector.SyncVectorEnv([lambda: made(env_id, options)] * 2)
    envs.reset(seed=0)
    found = envs.step(np.stack([env.action_space.high] * 2))[4]
    assert all(found[key].shape[0] == 2 and found[key].dtype != object for key in added)
    assert not [key for key in added if types[0][key] not in (float, bool, int, np.ndarray)]


SHAPES = {
    **{f"SafePointGoal{level}-v0": (size, 2, 0.02, 1000) for level, size in enumerate((28, 60, 60))},
    **{f"SafeCarGoal{level}-v0": (size, 2, 0.04, 1000) for level, size in enumerate((40, 72, 72))},
    "SafeRover-v0": (42, 5, 0.01, 1000),
    "OccludedCrossing-v0": (17, 3, 0.04, 500),
    "FlexJointReach-v0": (14, [3.0, 1.0], 0.01, 200),
    "TeleopContact-v0": (9, 2, 0.001, 6000),
}
"""Env -> observation, controls or what they reach, control step (s), steps of an episode."""


@pytest.mark.parametrize("env_id", SHAPES)
def test_spaces_timing_and_bad_actions(env_id):
    size, controls, dt, steps = SHAPES[env_id]
    env = gym.make(env_id)
    high = np.array(controls) if isinstance(controls, list) else np.ones(controls)
    assert env.action_space == gym.spaces.Box(np.float32(-high), np.float32(high), dtype=np.float32)
    assert (env.observation_space.shape, env.observation_space.dtype) == ((size,), np.float64)
    assert env.metadata["render_fps"] == round(1 / dt) and env.unwrapped.dt == pytest.approx(dt)
    assert env.spec.max_episode_steps == steps
    env.reset(seed=0)
    action, data = np.zeros(len(high)), env.unwrapped.data
    before = data.time, data.qpos.copy()
    for bad in (np.append(action, 0.0), action * np.nan, action - np.inf, 0.5, np.full(action.shape, "0.1")):
        with pytest.raises(ActionError, match=f"{len(action)} finite numbers"):
            env.unwrapped.step(bad)
        assert data.time == before[0] and np.array_equal(data.qpos, before[1])


# Layouts ----------------------------------------------------------------------------------------------------------

PILLARS = [[-2.5, -1.9], [2.5, -1.9], [-2.5, 1.9], [2.5, 1.9]]
OF_GOALS = {
    "agent": [0.5, -0.25, 0.75],
    "goal": [-1.0, 1.0],
    "hazards": [[1.0, 1.0], [0.0, 0.5]],
    "vases": [[-1.0, -1.0]],
}
LAYOUTS = {
    "SafePointGoal2-v0": OF_GOALS,
    "SafeCarGoal2-v0": OF_GOALS,
    "SafeRover-v0": {
        "agent": [1.0, 2.0, -3.0],
        "goal": [0.0, 1.0],
        "hazards": [[3.0, 3.0]],
        "patches": [
            {"ground": "snow", "center": (1.0, 2.0), "radius": 5.0},
            {"ground": "ice", "center": (1.0, 2.0), "radius": 0.4},
        ],
        "ground": "wet",
        "speed": -1.5,
    },
    "OccludedCrossing-v0": {
        "agent": [-1.0, 1.9, -1.0],
        "goal": [1.0, -1.9],
        "cars": [[float(i), 0.1 * i] for i in range(6)],
        "pillars": PILLARS[::-1],
    },
    "TeleopContact-v0": {"tool": [0.05, 0.1], "velocity": [0.2, -0.1], "wanted_force": 11.0},
}
SHOWN = {
    "agent": lambda env: [*env.agent_position, env.agent_heading],
    "goal": lambda env: env.goal_position,
    "hazards": lambda env: env.hazard_positions,
    "vases": lambda env: env.vase_positions,
    "cars": lambda env: np.stack([env.car_positions[:, 0], env.car_velocities[:, 0]], axis=1),
    "pillars": lambda env: env.pillar_positions,
    "tool": lambda env: env.tool_position,
    "velocity": lambda env: env.tool_velocity,
    "wanted_force": lambda env: env.wanted_force,
    "speed": lambda env: env.forward_speed,
}
"""Part of a layout -> how the env tells it."""


@pytest.mark.parametrize("env_id", LAYOUTS)
def test_a_layout_is_what_the_env_shows_for_one_episode(env_id):
    env, layout = gym.make(env_id).unwrapped, LAYOUTS[env_id]
    options = {"layout": copy.deepcopy(layout), "other": 1}
    env.reset(seed=3, options=options)
    assert options == {"layout": layout, "other": 1}
    for part in layout.keys() & SHOWN.keys():
        np.testing.assert_allclose(SHOWN[part](env), layout[part], atol=1e-12, err_msg=part)
    for part in layout.keys() & {"goal", "hazards", "vases", "pillars"}:  # they are drawn there
        for i, place in enumerate(np.atleast_2d(layout[part])):
            name = part if part == "goal" else f"{part[:-1]}{i}"
            np.testing.assert_allclose(env.data.body(name).xpos[:2], place)
    if "patches" in layout:
        assert [vars(patch) for patch in env.ground.patches] == layout["patches"]
        places = [(1.0, 2.3), (1.0, 2.5), (-3.9, -3.9)]
        assert [env.ground.at(*place) for place in places] == ["ice", "snow", "wet"]  # the later lies on top
        assert {env.ground_under(wheel) for wheel in env.wheels} == {"ice"}
    sampled = env.reset(seed=3, options={"layout": dict.fromkeys(layout)})[0]
    assert plain(sampled) == plain(gym.make(env_id).reset(seed=3)[0])


GIVEN = "OccludedCrossing-v0", "SafePointGoal1-v0", "SafeRover-v0", "TeleopContact-v0"
CROSSING, POINT, ROVER, TELEOP = GIVEN
ICE = {"ground": "ice", "center": [0, 0]}
REFUSED = [
    (POINT, {"hazard": [[0, 0]]}, UnknownNameError, "'hazard'.*agent, goal, hazards, vases"),
    (POINT, {"hazards": [[0, 0]] * 9}, ConfigurationError, "9 hazards.*at most 8"),
    (POINT, {"agent": [0, 0]}, ConfigurationError, r"'agent' must be \[x, y, heading\]"),
    (POINT, {"goal": [0, math.nan]}, ConfigurationError, "'goal' must be finite"),
    (POINT, {"hazards": [0, 0]}, ConfigurationError, r"'hazards' must be \[\[x, y\], \.\.\.\]"),
    (POINT, [1, 2], ConfigurationError, "must be a mapping"),
    (ROVER, {"ground": "mud"}, UnknownNameError, "'mud'.*dry, wet, snow, ice"),
    (ROVER, {"patches": {"ground": "ice"}}, ConfigurationError, "must be a list"),
    (ROVER, {"patches": [ICE]}, UnknownNameError, r"patches\[0\].*ground, center, radius"),
    (ROVER, {"patches": [ICE | {"radius": 0}]}, ConfigurationError, "radius > 0"),
    (ROVER, {"patches": [ICE | {"radius": 1}] * 9}, ConfigurationError, "9 patches.* 8"),
    (ROVER, {"speed": [1.0]}, ConfigurationError, "a number of m/s"),
    (CROSSING, {"agent": [0, 3.4, 0]}, ConfigurationError, r"\|y\| <= 3.3"),
    (CROSSING, {"agent": [-2.2, -1.9, 0], "pillars": PILLARS}, ConfigurationError, "in a pillar"),
    (CROSSING, {"cars": [[0, 1]] * 5}, ConfigurationError, "6 cars"),
    (CROSSING, {"pillars": [[x, -2.9] for x in (-1.5, -0.5, 0.5, 1.5)]}, ConfigurationError, "no room"),
    (TELEOP, {"tool": [0.19, 0.0]}, ConfigurationError, "inside the wall"),
    (TELEOP, {"tool": [0.0, 0.24]}, ConfigurationError, "the clamp"),
    (TELEOP, {"wanted_force": 0.0}, ConfigurationError, "above 0"),
    (TELEOP, {"wanted_force": 15.0}, ConfigurationError, "below the spring's limit of 15"),
]


@pytest.mark.parametrize(("env_id", "layout", "error", "message"), REFUSED)
def test_bad_layouts_are_refused_with_the_reason_and_change_nothing(env_id, layout, error, message):
    env = gym.make(env_id).unwrapped
    env.reset(seed=0)
    before = env.data.qpos.copy()
    with pytest.raises(error, match=message):
        env.reset(seed=1, options={"layout": layout})
    if message != "no room":  # which is found out by sampling
        np.testing.assert_array_equal(env.data.qpos, before)


def test_other_bad_arguments_are_refused():
    with pytest.raises(UnknownNameError, match="did you mean 'layout'"):
        gym.make(POINT).reset(options={"layuot": OF_GOALS})
    with pytest.raises(ConfigurationError, match="0, 1, 2; got 3"):
        gym.make(POINT, level=3)


# Sampled places and goals that move on --------------------------------------------------------------------------

COUNTS = {
    **{
        f"SafePointGoal{k}-v0": {"hazards": h, "vases": v}
        for k, (h, v) in enumerate([(0, 0), (8, 1), (10, 10)])
    },
    "SafeCarGoal2-v0": {"hazards": 10, "vases": 10},
    "SafeRover-v0": {"hazards": 6},
}


def apart(env, keepouts, half_extent, goal_only=False):
    """All objects are in the field, or only a later goal is, and no two of them too near each other."""
    objects = [
        (name, place[:2]) for name in keepouts if name in SHOWN for place in np.atleast_2d(SHOWN[name](env))
    ]
    for name, place in objects:
        assert (goal_only and name != "goal") or np.abs(place).max() <= half_extent - keepouts[name]
    for (a, p), (b, q) in itertools.combinations(objects, 2):
        assert (goal_only and "goal" not in (a, b)) or math.dist(p, q) >= keepouts[a] + keepouts[b]


@pytest.mark.parametrize("env_id", COUNTS)
def test_what_is_sampled_keeps_apart_and_later_goals_do_too(env_id):
    env, counts, headings = gym.make(env_id).unwrapped, COUNTS[env_id], []
    if env_id == ROVER:
        keepouts, half_extent = safe_rover.KEEPOUTS, safe_rover.HALF_EXTENT
    else:
        level = env.level
        keepouts, half_extent = (
            {k: v for k, v in goal_env.KEEPOUTS.items() if counts.get(k, 1)},
            level.half_extent,
        )
    given = {"agent": [0.3, -0.2, 1.0]} | ({"hazards": [[1.0, 1.0]]} if counts["hazards"] else {})
    for seed in range(30):
        env.reset(seed=seed)
        apart(env, keepouts, half_extent)
        assert all(len(SHOWN[name](env)) == count for name, count in counts.items() if count)
        headings.append(env.agent_heading)
        env.reset(seed=seed, options={"layout": given})
        apart(env, keepouts, half_extent)
        assert all(np.allclose(SHOWN[part](env), given[part]) for part in given)
        qpos, old = env.data.qpos.copy(), env.goal_position
        qpos[:2] = old
        env.set_state(qpos, np.zeros(env.model.nv))
        info = env.step(np.zeros(env.action_space.shape))[4]
        assert info["goal_met"] and info["goals_reached"] == 1 and not np.array_equal(env.goal_position, old)
        apart(env, keepouts, half_extent, goal_only=True)
    assert min(headings) < -2 and max(headings) > 2


def test_a_field_without_room_is_refused_at_the_start_and_never_later():
    rng, grid = np.random.default_rng(0), np.linspace(-0.6, 0.6, 3)
    blocked = {"hazards": np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)}
    with pytest.raises(ConfigurationError, match=r"no room .* \[-1\.0, 1\.0\]\^2"):
        place_objects(rng, 1.0, goal_env.KEEPOUTS, {"vases": 0}, blocked)
    found = [place_goal_beside(rng, 1.0, goal_env.KEEPOUTS, blocked) for _ in range(20)]
    gaps = [np.hypot(*(goal - blocked["hazards"]).T).min() for goal in found]
    assert np.abs(found).max() <= 0.695 and min(gaps) > 0.3  # at most 0.42: the clearest of many


@pytest.mark.parametrize("env_id", ["SafePointGoal1-v0", "SafeCarGoal0-v0", ROVER, CROSSING])
def test_reward_is_distance_gained_plus_one_on_reaching(env_id):
    env, rng, reached = gym.make(env_id).unwrapped, np.random.default_rng(0), 0
    env.action_space.seed(0)
    env.reset(seed=0)
    for step in range(200):
        goal = env.goal_position
        if step % 10 == 0:  # to a place about the goal's edge
            qpos, angle = env.data.qpos.copy(), rng.uniform(-math.pi, math.pi)
            distance = env.goal_radius + rng.uniform(0.0, 0.01)
            qpos[:2] = goal + distance * np.array([math.cos(angle), math.sin(angle)])
            env.set_state(qpos, 0.2 * rng.normal(size=env.model.nv))
        before = math.dist(env.agent_position, goal)
        _, reward, terminated, truncated, info = env.step(env.action_space.sample())
        after = math.dist(env.agent_position, goal)
        reached += after <= env.goal_radius
        assert info["goal_met"] == (after <= env.goal_radius) != np.array_equal(env.goal_position, goal)
        assert reward == pytest.approx(before - after + info["goal_met"], abs=1e-12)
        assert info["goals_reached"] == reached and not (terminated or truncated)
    assert reached > 3
    assert env.reset()[1]["goals_reached"] == 0


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("env_id", [CROSSING, ROVER, TELEOP])
def test_a_state_that_is_not_finite_is_said(env_id, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warning into a log here
    env = gym.make(env_id).unwrapped
    env.reset(seed=0)
    qvel = np.zeros(env.model.nv)
    qvel[0] = math.nan
    env.set_state(env.data.qpos.copy(), qvel)
    with pytest.raises(SafeWrappersError, match="not finite"):
        env.step(np.zeros(env.action_space.shape))
    assert np.isfinite(env.reset(seed=0)[0]).all()


# Frames -----------------------------------------------------------------------------------------------------------

FRAME = """
import sys
import gymnasium as gym
import numpy as np
import safe_wrappers

env = gym.make("SafePointGoal1-v0", render_mode="rgb_array", width=160, height=120, camera_name="top")
layout = {"agent": [-1.0, -1.0, 0.0], "goal": [1.0, 1.0], "hazards": [[0.0, 0.0]], "vases": []}
env.reset(seed=0, options={"layout": layout})
np.save(sys.argv[1], env.render())
assert abs(env.unwrapped.data.cam("top").xmat.reshape(3, 3)[2, 2] - 1.0) < 1e-6
"""


def test_frames_show_the_scenario(gl, tmp_path):
    drawn = tmp_path / "frame.npy"
    subprocess.run([sys.executable, "-c", FRAME, str(drawn)], env=gl, check=True, timeout=300)
    frame = np.load(drawn).astype(int)
    assert frame.shape == (120, 160, 3)
    middle = frame[60, 80]
    assert middle[2] > middle[0] + 20  # the hazard's blue, where the camera looks
    red, green, blue = np.moveaxis(frame, -1, 0)
    goal = np.argwhere((green > red + 30) & (green > blue + 30)).mean(axis=0)
    robot = np.argwhere((red > green + 60) & (red > blue + 60)).mean(axis=0)
    assert goal[0] < 60 < robot[0]  # y grows upwards in the picture
    assert robot[1] < 80 < goal[1]
