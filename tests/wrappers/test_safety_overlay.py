"""SafetyOverlay changes nothing but the picture, and the picture shows what it should."""

import json
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box

import safe_wrappers as sw
from benchmarks import car_drivers
from safe_wrappers import info as keys
from safe_wrappers.drawing.scene import MOST_MARKS, put
from safe_wrappers.envs.safe_rover import WHEELS
from safe_wrappers.errors import ConfigurationError

TASK = "SafePointGoal1-v0"


RAIL = [sw.constraints.Plane([-0.9], [1]), sw.constraints.Plane([0.9], [-1])]


def make(task=TASK, wrap=sw.protect):
    return wrap(gym.make(task, render_mode="rgb_array"))


class Plain(gym.Env):
    """Draws frames by itself, without MuJoCo."""

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 10}  # noqa: RUF012
    action_space = Box(-1.0, 1.0, (1,), np.float32)
    observation_space = Box(-1.0, 1.0, (1,), np.float32)
    closed = 0

    def __init__(self, render_mode="rgb_array"):
        self.render_mode = render_mode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        return np.zeros(1, np.float32), 0.0, False, False, {keys.COST: 1.0}

    def render(self):
        return np.full((200, 300, 3), 255, np.uint8)

    def close(self):
        self.closed += 1


class Viewer:
    """What Gymnasium's viewers have, and nothing that draws."""

    def __init__(self):
        self.markers, self.words, self.frames = [], [], []

    def add_marker(self, **marker):
        self.markers.append(marker)

    def add_overlay(self, place, text, more):
        self.words.append(text)


class Renderer:
    def __init__(self):
        self.viewer, self.modes = Viewer(), []

    def _get_viewer(self, mode):
        self.modes.append(mode)
        return self.viewer


# What is refused ----------------------------------------------------------------------------------------------


def test_an_env_without_frames_is_refused_with_the_line_to_write():
    with pytest.raises(
        ConfigurationError, match=r"render_mode is None: .*gym.make\(\.\.\., render_mode='rgb_array'"
    ):
        sw.SafetyOverlay(sw.protect(gym.make(TASK)))
    with pytest.raises(ConfigurationError, match="'depth_array'"):
        sw.SafetyOverlay(sw.protect(gym.make(TASK, render_mode="depth_array")))


# Nothing is changed -------------------------------------------------------------------------------------------


def crossing(env):
    cars = sw.occlusion.Track("car*", acceleration_noise=[0.02, 0.0], start_velocity_std=[1.0, 0.1])
    return sw.protect(sw.OcclusionPenalty(env, [cars], "eye", tolerance=0.5))


STACKS = {
    TASK: sw.protect,
    "SafeCarGoal1-v0": sw.protect,
    "HalfCheetah-v5": lambda env: sw.CBFActionFilter(env, [sw.constraints.SpeedLimit(0.5, horizon=2)]),
    "SafeRover-v0": lambda env: sw.SlipLimiter(env, wheels=list(WHEELS)),
    "OccludedCrossing-v0": crossing,
    "Ant-v5": lambda env: sw.WholeBodyFilter(env, zmp_inset=0.02),
    "FetchReach-v4": sw.protect,
    "PatrolledPointMaze-v0": sw.protect,
    "InvertedPendulum-v5": lambda env: sw.LeaseExpiry(
        sw.CBFActionFilter(env, [sw.constraints.JointSpeedLimit(1.0, joints=["slider"])]),
        sw.StoppingBudget(sw.constraints.Clearance(RAIL, 8.0, bodies=["cart"]), acceleration=30.0),
    ),
}
DRIVERS = {
    TASK: lambda env, rng: lambda: np.array([1.0, 0.0]),
    "SafeCarGoal1-v0": car_drivers.hazard_seeking,
}
"""Who meets the filter sooner than corners of the action space do."""


def episode(env, looking):
    task = env.spec.id
    act = DRIVERS[task](env.unwrapped, np.random.default_rng(0)) if task in DRIVERS else None
    rng = np.random.default_rng(0)
    around = {"agent": [0, 0, 0], "hazards": [[0.6, 0.0], [-0.6, 0.0], [0.0, 0.6], [0.0, -0.6]]}
    seen = [env.reset(seed=0, options={"layout": around} if act else None)]
    space = env.action_space
    for step in range(100 if act else 40):
        if act:
            action = act()
        elif step % 10 == 0:
            action = np.where(rng.random(space.shape) < 0.5, space.low, space.high)
        if looking and step % 3 == 0:
            env.marks()
            env.marks()
        seen.append(env.step(action.astype(space.dtype)))
    return seen, env.unwrapped.np_random.bit_generator.state


def plain(seen):
    return json.dumps(seen, default=lambda v: v.tobytes().hex() if isinstance(v, np.ndarray) else repr(v))


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("task", STACKS)
def test_observations_rewards_infos_and_random_numbers_are_those_without_it(task):
    if "Fetch" in task or "Maze" in task:
        gym.register_envs(pytest.importorskip("gymnasium_robotics"))
    bare, bare_random = episode(make(task, STACKS[task]), False)
    env = sw.SafetyOverlay(make(task, STACKS[task]))
    drawn, drawn_random = episode(env, True)
    assert plain(drawn) == plain(bare)
    assert drawn_random == bare_random
    if "Rover" not in task:
        assert any(step[-1][keys.CBF_INTERVENED] for step in bare[1:])


# Pictures -----------------------------------------------------------------------------------------------------


def test_another_env_gets_a_strip_on_a_frame_of_the_same_shape_and_closes_twice():
    env = sw.SafetyOverlay(Plain())
    env.reset(seed=0)
    quiet = env.render()
    env.step(np.zeros(1, np.float32))
    frame = env.render()
    assert frame.shape == (200, 300, 3) and (frame[:100] == 255).all()
    assert (frame != quiet).any()  # the step costs
    env.close()
    env.close()
    assert env.unwrapped.closed == 2


def test_a_frame_s_marks_are_those_of_the_present_state_and_never_too_many():
    env = sw.SafetyOverlay(make())
    env.reset(seed=0)
    renderer = Renderer()
    put(env.marks() * 100, renderer, "rgb_array")
    assert len(renderer.viewer.markers) == MOST_MARKS and renderer.modes == ["rgb_array"]
    first = env.marks()
    for _ in range(10):
        env.step(np.array([1.0, 0.0], np.float32))
    at = [mark.position[:2] for mark in env.marks() if mark.role == "way"]
    assert min(np.linalg.norm(p - env.unwrapped.agent_position) for p in at) < 0.05
    assert len(first) > 8 * 12


def test_a_window_gets_marks_and_words_before_each_step():
    task = gym.make(TASK, render_mode="rgb_array")
    renderer = task.unwrapped.mujoco_renderer = Renderer()
    task.unwrapped.render_mode = "human"
    task.unwrapped.render = lambda: None
    env = sw.SafetyOverlay(sw.protect(task))
    env.reset(seed=0)
    assert not renderer.viewer.markers
    env.step(np.zeros(2, np.float32))
    assert renderer.viewer.markers and renderer.viewer.words[0] == "as proposed"
    assert renderer.viewer.words[1].startswith("margin ") and set(renderer.modes) == {"human"}


# With GL ------------------------------------------------------------------------------------------------------

SCRIPT = """
import gymnasium as gym, numpy as np, safe_wrappers as sw

def run(overlay):
    env = sw.protect(gym.make("SafePointGoal1-v0", render_mode="rgb_array", width=320, height=240))
    env = sw.SafetyOverlay(env) if overlay else env
    seen = [env.reset(seed=0)[0]]
    frames = [env.render()]
    for _ in range(8):
        seen.append(env.step(np.array([1.0, 0.5], np.float32))[0])
        frames.append(env.render())
    env.close()
    env.close()
    return np.array(seen), np.array(frames)

bare, plain = run(False)
drawn, shown = run(True)
assert (bare == drawn).all()
assert plain.shape == shown.shape
strip = round(0.14 * 240)
different = (plain != shown).any(axis=-1)
assert different[:, -strip:].mean() > 0.9, different[:, -strip:].mean()
above = different[:, :-strip].mean()
assert 0.002 < above < 0.2, above  # rings and arrows, and the floor as it was

# An arrow ends where its mark says.
from safe_wrappers.drawing.marks import arrow, ball
from safe_wrappers.drawing.scene import find_renderer, put

env = gym.make("SafePointGoal0-v0", render_mode="rgb_array", width=320, height=240, default_camera_config={
    "distance": 6.0, "elevation": -90.0, "azimuth": 90.0, "lookat": np.zeros(3)})
env.reset(seed=0)

def at(mark):
    before = env.render().astype(int)
    put([mark], find_renderer(env), "rgb_array")
    return np.argwhere(np.abs(env.render() - before).sum(axis=-1) > 60)[:, 1]

tip = at(ball("executed", [1.0, 0.0, 0.5], 0.05)).mean()
assert abs(at(arrow("executed", [0.0, 0.0, 0.5], [1.0, 0.0, 0.0], 0.05)).max() - tip) < 4
print("drawn")
"""


def test_frames_show_it_and_nothing_else_is_changed(gl):
    done = subprocess.run([sys.executable, "-c", SCRIPT], env=gl, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "drawn"
