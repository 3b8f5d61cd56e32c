"""SafetyOverlay changes nothing but the picture, and the picture shows what it should."""

import json
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers import info as keys
from safe_wrappers.envs.safe_rover import WHEELS
from safe_wrappers.wrappers.safety_overlay import KEEP_OUT, LIMIT, MOST_MARKS, WAY

TASK = "SafePointGoal1-v0"
RAIL = [sw.constraints.Plane([-0.9], [1]), sw.constraints.Plane([0.9], [-1])]


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
STRAIGHT = {TASK: [1.0, 0.0], "SafeCarGoal1-v0": [1.0, 1.0]}
"""Into a hazard; elsewhere corners of the action space meet the filter soon."""


def episode(task, looking):
    """What it gives, in full, and whether the filter has acted."""
    env = STACKS[task](gym.make(task, render_mode="rgb_array"))
    env = sw.SafetyOverlay(env) if looking else env
    ahead, rng, space = STRAIGHT.get(task), np.random.default_rng(0), env.action_space
    around = {"agent": [0, 0, 0], "hazards": [[0.6, 0.0], [-0.6, 0.0], [0.0, 0.6], [0.0, -0.6]]}
    seen = [env.reset(seed=0, options={"layout": around} if ahead else None)]
    for step in range(100 if ahead else 40):
        if step % 10 == 0:
            action = ahead or np.where(rng.random(space.shape) < 0.5, space.low, space.high)
        if looking and step % 3 == 0:
            env.marks()
            env.marks()
        seen.append(env.step(np.array(action, space.dtype)))
    whole = [seen, env.unwrapped.np_random.bit_generator.state]
    text = json.dumps(whole, default=lambda v: v.tobytes().hex() if isinstance(v, np.ndarray) else repr(v))
    return text, any(step[-1].get(keys.CBF_INTERVENED) for step in seen)


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("task", STACKS)
def test_observations_rewards_infos_and_random_numbers_are_those_without_it(task):
    if "Fetch" in task or "Maze" in task:
        gym.register_envs(pytest.importorskip("gymnasium_robotics"))
    bare, intervened = episode(task, False)
    assert episode(task, True)[0] == bare
    assert intervened or "Rover" in task


@pytest.mark.parametrize("task", list(STRAIGHT))
def test_every_disc_has_a_ring_where_the_margin_begins(task):
    env = sw.SafetyOverlay(sw.protect(gym.make(task, render_mode="rgb_array")))
    env.reset(seed=0)
    centers = env.unwrapped.hazard_positions
    rods = [mark for mark in env.marks() if mark["rgba"] == LIMIT]
    ends = [mark["pos"] - mark["size"][2] * mark["mat"].reshape(3, 3)[:, 2] for mark in rods]
    rings = np.reshape(ends, (len(centers), -1, 3))[..., :2]
    radii = np.linalg.norm(rings - centers[:, None], axis=2)
    np.testing.assert_allclose(radii, 0.2 + env.get_wrapper_attr("constraints")[0].margin)
    np.testing.assert_allclose(rings.mean(axis=1), centers, atol=1e-9)


def test_planes_are_moved_by_what_is_kept_free():
    keep = sw.constraints.Clearance(RAIL, 8.0, bodies=["cart"], radius=0.1, margin=0.05, state_error=0.01)
    env = gym.make("InvertedPendulum-v5", render_mode="rgb_array")
    env = sw.SafetyOverlay(sw.CBFActionFilter(env, [keep]))
    env.reset(seed=0)
    env.step(np.array([3.0], np.float32))
    left, right, point = (
        mark for colour in (KEEP_OUT, WAY) for mark in env.marks() if mark["rgba"] == colour
    )
    np.testing.assert_allclose([left["pos"][0], right["pos"][0]], [-0.74, 0.74])
    for pad in (left, right):
        np.testing.assert_allclose(np.abs(pad["mat"].reshape(3, 3)[:, 2]), [1.0, 0.0, 0.0], atol=1e-12)
    assert point["pos"][0] == env.unwrapped.data.qpos[0] and point["size"][0] == 0.1


class Renderer:
    """What Gymnasium's renderers and viewers have, and nothing that draws."""

    def __init__(self):
        self.markers, self.words, self.modes = [], [], []

    def _get_viewer(self, mode):
        self.modes.append(mode)
        return self

    def add_marker(self, **marker):
        self.markers.append(marker)

    def add_overlay(self, place, text, more):
        self.words.append(text)


def overlay(renderer, mode="rgb_array"):
    """Around a task whose frames are white."""
    env = gym.make(TASK, render_mode="rgb_array")
    env.unwrapped.mujoco_renderer, env.unwrapped.render_mode = renderer, mode
    env.unwrapped.render = lambda: np.full((200, 300, 3), 255, np.uint8)
    return sw.SafetyOverlay(sw.protect(env))


def test_another_env_gets_a_strip_on_a_frame_of_the_same_shape():
    env = overlay(None)
    env.reset(seed=0)
    quiet = env.render()
    env.step(np.ones(2, np.float32))
    frame = env.render()
    assert frame.shape == (200, 300, 3) and (frame[:192] == 255).all()
    assert (frame != quiet).any()


def test_a_frame_s_marks_are_those_of_the_present_state_and_never_too_many():
    renderer = Renderer()
    env = overlay(renderer)
    assert not env.marks()
    env.reset(seed=0)
    first = env.marks()
    for _ in range(10):
        env.step(np.array([1.0, 0.0], np.float32))
    rod = next(mark for mark in env.marks() if mark["rgba"] == WAY)  # the first of the way
    begins = rod["pos"] - rod["size"][2] * rod["mat"].reshape(3, 3)[:, 2]
    np.testing.assert_allclose(begins[:2], env.unwrapped.agent_position, atol=1e-9)
    env.marks = lambda: 100 * first
    env.render()
    assert len(renderer.markers) == MOST_MARKS < 100 * len(first) and renderer.modes == ["rgb_array"]


def test_a_window_gets_marks_and_words_before_each_step():
    renderer = Renderer()
    env = overlay(renderer, "human")
    env.reset(seed=0)
    assert not renderer.markers
    env.step(np.zeros(2, np.float32))
    assert len(renderer.markers) > 8 * 12 and renderer.words == ["as proposed"]
    assert set(renderer.modes) == {"human"}


SCRIPT = """
import gymnasium as gym, numpy as np, safe_wrappers as sw

def run(overlay):
    env = sw.protect(gym.make("SafePointGoal1-v0", render_mode="rgb_array", width=320, height=240))
    env = sw.SafetyOverlay(env) if overlay else env
    env.reset(seed=0)
    steps = [(env.step(np.array([1.0, 0.5], np.float32))[0], env.render()) for _ in range(8)]
    env.close()
    env.close()
    return map(np.array, zip(*steps))

(bare, plain), (drawn, shown) = run(False), run(True)
assert (bare == drawn).all()
different = (plain != shown).any(axis=-1)
assert different[:, -10:].mean() > 0.9, different[:, -10:].mean()
above = different[:, :-10].mean()
assert 0.002 < above < 0.2, above  # rings, and the floor as it was
print("drawn")
"""


def test_frames_show_it_and_nothing_else_is_changed(gl):
    done = subprocess.run([sys.executable, "-c", SCRIPT], env=gl, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "drawn"
