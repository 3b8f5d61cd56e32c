"""SafetyOverlay changes nothing but the picture, and the picture shows what it should."""

import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from episodes import trace
from hypothesis import given
from hypothesis import strategies as st
from scenes import make
from wrapper_examples import rail

import safe_wrappers as sw
from safe_wrappers import info as keys
from safe_wrappers.wrappers.safety_overlay import KEEP_OUT, LIMIT, MOST_MARKS, WAY
from safe_wrappers.wrappers.strip import STATES, STEPS, state_of, with_strip

TASK = "SafePointGoal1-v0"
STILL, AHEAD = np.zeros(2, np.float32), np.array([1.0, 0.0], np.float32)


def made(task, wrap=sw.protect):
    return wrap(make(task, render_mode="rgb_array"))


def crossing(env):
    cars = sw.occlusion.Track("car*", acceleration_noise=[0.02, 0.0], start_velocity_std=[1.0, 0.1])
    return sw.protect(sw.OcclusionPenalty(env, [cars], "eye", tolerance=0.5))


def leased(env):
    speed = sw.CBFActionFilter(env, [sw.constraints.JointSpeedLimit(1.0, joints=["slider"])])
    return sw.LeaseExpiry(speed, sw.StoppingBudget(rail(), acceleration=30.0))


class Looking(sw.SafetyOverlay):
    def step(self, action):
        self.marks()
        return super().step(action)


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize(
    ("task", "wrap"),
    [
        (TASK, sw.protect),
        ("SafeCarGoal1-v0", sw.protect),
        ("HalfCheetah-v5", lambda env: sw.CBFActionFilter(env, [sw.constraints.SpeedLimit(0.5, horizon=2)])),
        ("OccludedCrossing-v0", crossing),
        ("FetchReach-v4", sw.protect),
        ("PatrolledPointMaze-v0", sw.protect),
        ("InvertedPendulum-v5", leased),
    ],
)
def test_everything_but_the_picture_is_as_without_it(task, wrap):
    without = trace(made(task, wrap), steps=100)
    assert trace(Looking(made(task, wrap)), steps=100) == without
    assert task in (TASK, "SafeCarGoal1-v0") or any(step[4][keys.CBF_INTERVENED] for step in without[1:])


# Marks in the scene -----------------------------------------------------------------------------------------------


def of_colour(env, *colours):
    return [mark for colour in colours for mark in env.marks() if mark["rgba"] == colour]


def begins(rods):
    """Where thin boxes begin, shape (n, 3), m."""
    return np.array([rod["pos"] - rod["size"][2] * rod["mat"].reshape(3, 3)[:, 2] for rod in rods])


@pytest.mark.parametrize("task", [TASK, "SafeCarGoal1-v0"])
def test_every_disc_has_a_ring_where_the_margin_begins(task):
    env = sw.SafetyOverlay(made(task))
    assert not env.marks()
    env.reset(seed=0)
    centers = env.unwrapped.hazard_positions
    rings = begins(of_colour(env, LIMIT)).reshape(len(centers), -1, 3)[..., :2]
    radii = np.linalg.norm(rings - centers[:, None], axis=2)
    np.testing.assert_allclose(radii, 0.2 + env.get_wrapper_attr("constraints")[0].margin)
    np.testing.assert_allclose(rings.mean(axis=1), centers, atol=1e-9)


def test_planes_are_moved_by_what_is_kept_free():
    keep = rail(radius=0.1, margin=0.05, state_error=0.01)
    env = sw.SafetyOverlay(made("InvertedPendulum-v5", lambda env: sw.CBFActionFilter(env, [keep])))
    env.reset(seed=0)
    env.step(np.array([3.0], np.float32))
    left, right, point = of_colour(env, KEEP_OUT, WAY)
    np.testing.assert_allclose([left["pos"][0], right["pos"][0]], [-0.74, 0.74])
    for pad in (left, right):
        np.testing.assert_allclose(np.abs(pad["mat"].reshape(3, 3)[:, 2]), [1.0, 0.0, 0.0], atol=1e-12)
    assert point["pos"][0] == env.unwrapped.data.qpos[0] and point["size"][0] == 0.1


@pytest.mark.filterwarnings("ignore::safe_wrappers.UnsafeStateWarning")
def test_a_box_that_is_kept_has_its_edges_and_what_is_kept_out_its_size():
    ball = sw.constraints.Sphere([0.1, 0.1, 0.01], 0.05)
    block = sw.constraints.Box([0.0, -0.1, 0.0], [0.03, 0.02, 0.01])
    limit = sw.constraints.Workspace(
        [-0.2, -0.2, -0.1], [0.2, 0.2, 0.1], keep_out=[ball, block], bodies=["fingertip"], margin=0.01
    )
    env = sw.SafetyOverlay(made("Reacher-v5", lambda env: sw.CBFActionFilter(env, [limit])))
    env.reset(seed=0)
    corners = np.unique(begins(of_colour(env, LIMIT)).round(9), axis=0)
    assert len(of_colour(env, LIMIT)) == 12
    np.testing.assert_allclose(np.abs(corners), np.tile([0.19, 0.19, 0.09], (len(corners), 1)))
    sphere, box = of_colour(env, KEEP_OUT)
    assert sphere["pos"].tolist() == ball.center and sphere["size"][0] == pytest.approx(0.06)
    assert box["pos"].tolist() == block.center
    np.testing.assert_allclose(box["size"], [0.04, 0.03, 0.02])


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
    env = sw.SafetyOverlay(sw.protect(env))
    env.reset(seed=0)
    return env


def test_a_frame_s_marks_are_those_of_the_present_state_and_never_too_many():
    renderer = Renderer()
    env = overlay(renderer)
    for _ in range(10):
        env.step(AHEAD)
    (start, *_) = begins(of_colour(env, WAY)[:1])
    np.testing.assert_allclose(start[:2], env.unwrapped.agent_position, atol=1e-9)
    many = 100 * env.marks()
    env.marks = lambda: many
    env.render()
    assert len(renderer.markers) == MOST_MARKS < len(many) and renderer.modes == ["rgb_array"]


def test_a_window_gets_marks_and_words_before_each_step():
    renderer = Renderer()
    env = overlay(renderer, "human")
    assert not renderer.markers
    env.step(STILL)
    assert len(renderer.markers) > 8 * 12 and renderer.words == ["as proposed"]
    assert set(renderer.modes) == {"human"}


# The strip --------------------------------------------------------------------------------------------------------


def test_the_worst_of_what_a_step_reports_is_its_state():
    assert state_of({}) == state_of({keys.COST: 0.0}) == "as proposed"
    info = {}
    for key, state in (
        (keys.CBF_INTERVENED, "changed"),
        (keys.LEASE_BRAKING, "braked"),
        (keys.CBF_FALLBACK, "fallback"),
        (keys.COST_SUBSTEP, "violation"),
    ):
        info[key] = True
        assert state_of(info) == state
    assert state_of({keys.TELEOP_REVOKED: True}) == "braked" and state_of({keys.COST: 1.0}) == "violation"


@given(st.integers(4, 120), st.integers(1, 400), st.lists(st.sampled_from(list(STATES)), max_size=STEPS))
def test_columns_are_steps_in_the_colour_of_the_state_the_last_at_the_right(height, width, states):
    frame = np.zeros((height, width, 3), np.uint8)
    drawn = with_strip(frame, states)
    high = max(4, height // 24)
    assert drawn.shape == frame.shape and not frame.any() and not drawn[:-high].any()
    assert (drawn[-high:] == drawn[-1]).all() and drawn[-1].any(axis=-1).all()
    if width >= STEPS:  # a column of each step is where its share of the width begins
        columns = (np.arange(STEPS) * width // STEPS)[STEPS - len(states) :]
        assert [tuple(colour) for colour in drawn[-1, columns]] == [STATES[state][0] for state in states]
    elif states:
        assert tuple(drawn[-1, -1]) == STATES[states[-1]][0]


def test_an_env_that_is_not_mujoco_s_gets_a_strip_on_a_frame_of_the_same_shape():
    env = overlay(None)
    quiet = env.render()
    env.step(np.ones(2, np.float32))
    frame = env.render()
    assert frame.shape == (200, 300, 3) and (frame[:192] == 255).all() and (frame != quiet).any()
    env.reset(seed=0)
    assert (env.render() == quiet).all()


SCRIPT = """
import gymnasium as gym, numpy as np, safe_wrappers as sw

def run(overlay):
    env = sw.protect(gym.make("SafePointGoal1-v0", render_mode="rgb_array", width=320, height=240))
    env = sw.SafetyOverlay(env) if overlay else env
    env.reset(seed=0)
    frames = [(env.step(np.array([1.0, 0.5], np.float32)), env.render())[1] for _ in range(8)]
    env.close()
    env.close()
    return np.array(frames)

different = (run(False) != run(True)).any(axis=-1)
above = different[:, :-10].mean()
assert different[:, -10:].mean() > 0.9 and 0.002 < above < 0.2, above  # rings, and the floor as it was
print("drawn")
"""


def test_frames_show_it(gl):
    done = subprocess.run([sys.executable, "-c", SCRIPT], env=gl, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0 and done.stdout.strip() == "drawn", done.stderr
