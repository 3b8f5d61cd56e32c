"""What Gymnasium asks of every env that the package registers."""

import copy
import os
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

import safe_wrappers.envs
from safe_wrappers.errors import ActionError

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


OURS = [env_id for env_id, _ in TASKS if not any(word in env_id for word in ("Velocity", "Maze"))]


@pytest.mark.parametrize("env_id", OURS)
def test_a_bad_action_is_refused_and_the_env_not_stepped(env_id):
    env = gym.make(env_id).unwrapped
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape)
    before = env.data.time, env.data.qpos.copy()
    for bad in (np.append(action, 0.0), action * np.nan, action - np.inf, 0.5, np.full(action.shape, "0.1")):
        with pytest.raises(ActionError, match=f"{len(action)} finite numbers"):
            env.step(bad)
        assert env.data.time == before[0] and np.array_equal(env.data.qpos, before[1])


@pytest.mark.parametrize("robot", ["Point", "Car"])
def test_spaces_and_timing_of_the_goal_tasks(robot):
    for level, size in enumerate((28, 60, 60) if robot == "Point" else (40, 72, 72)):
        env = gym.make(f"Safe{robot}Goal{level}-v0")
        assert env.observation_space.shape == (size,)
        assert env.action_space == gym.spaces.Box(-1, 1, (2,), np.float32)
        assert env.unwrapped.dt == pytest.approx(0.02 if robot == "Point" else 0.04)
        assert env.metadata["render_fps"] == round(1 / env.unwrapped.dt)


def test_registering_imports_no_physics_and_stepping_needs_no_gl():
    # Loaded by its file, because the package around it may import MuJoCo for its plants.
    code = """
import sys, importlib.util as u
spec = u.spec_from_file_location('alone', sys.argv[1])
module = u.module_from_spec(spec); spec.loader.exec_module(module); module.register_envs()
assert 'mujoco' not in sys.modules
import gymnasium as gym
env = gym.make('SafeCarGoal2-v0', render_mode='rgb_array'); env.reset(seed=0)
env.step(env.action_space.sample())
"""
    command = [sys.executable, "-c", code, safe_wrappers.envs.__file__]
    environ = os.environ | {"MUJOCO_GL": "disabled"}
    done = subprocess.run(command, env=environ, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


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
