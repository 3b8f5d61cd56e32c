"""WallClearance against MuJoCo itself: what is admitted stays clear, and is as close to what was asked as can be."""

import warnings

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from asking import Asked
from hypothesis import assume, given
from hypothesis import strategies as st
from scenes import Scene

import safe_wrappers as sw

RADIUS = 0.1
BLOCKS = [
    (-3, 0, 1, 4),
    (3, 0, 1, 4),
    (0, -3, 4, 1),
    (0, 3, 4, 1),
    (0.6, 0.5, 0.4, 0.5),
    (-0.9, -0.6, 0.3, 0.2),
]
"""x, y, half size along x, half size along y."""
CENTRES, SIZES = np.hsplit(np.array(BLOCKS), 2)
ROOM_WITH_BLOCKS = """<mujoco><option timestep="0.01" gravity="0 0 0"/>
<default><joint damping="1"/><geom margin="0.002" density="1000" condim="1"/></default>
<worldbody>{blocks}<body name="ball">
<joint name="y" type="slide" axis="0 1 0"/><joint name="x" type="slide" axis="1 0 0"/><geom size="0.1"/></body>
</worldbody>
<actuator><motor joint="x" ctrlrange="-1 1" gear="100"/><motor joint="y" ctrlrange="-0.8 1" gear="90"/></actuator>
</mujoco>"""


class PointWorld(Scene):
    """A ball on two slides, y first, in a room with two blocks.

    Args:
        frame_skip: Physics steps per control step.
        clip: Speed per axis to which it clips at the start of every control step; None does not.
    """

    start = [-0.3, 0.0], [0.0, 0.0]

    def __init__(self, frame_skip=1, clip=None):
        blocks = "".join(f'<geom type="box" pos="{x} {y} 0.2" size="{a} {b} 0.2"/>' for x, y, a, b in BLOCKS)
        super().__init__(ROOM_WITH_BLOCKS.format(blocks=blocks), frame_skip)
        self.clip, self.scratch = clip, mujoco.MjData(self.model)
        low, high = self.model.actuator_ctrlrange.astype(np.float32).T
        self.action_space = gym.spaces.Box(low, high)

    def place(self, at, velocity):
        """Put the ball somewhere: x, y and velocity along x, y."""
        self.data.qpos[:], self.data.qvel[:] = at[::-1], velocity[::-1]

    def step(self, action):
        if self.clip is not None:
            self.data.qvel[:] = np.clip(self.data.qvel, -self.clip, self.clip)
        self.data.ctrl[:] = action
        gaps, touches = [], []
        for _ in range(self.frame_skip):
            mujoco.mj_step(self.model, self.data)
            gaps.append(self.gap())
            self.scratch.qpos[:] = self.data.qpos  # `data.contact` is one step old
            mujoco.mj_fwdPosition(self.model, self.scratch)
            touches.append(self.scratch.ncon > 0)
        return np.zeros(1), 0.0, False, False, {"touched": any(touches), "nearest": min(gaps)}

    def gap(self):
        """Distance of the ball's surface from the nearest wall, m, from positions alone."""
        beyond = np.abs(self.data.qpos[::-1] - CENTRES) - SIZES
        outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
        return float((outside + np.minimum(beyond.max(axis=1), 0.0)).min()) - RADIUS


MARGIN = 0.001
ROOM = RADIUS + 2 * 0.002 + MARGIN
"""From the ball's centre to a wall: radius, both contact margins, the constraint's own."""


def filtered(world=None, **options):
    env = sw.CBFActionFilter(world or PointWorld(clip=5.0), [sw.constraints.WallClearance(**options)])
    env.reset(seed=0)
    return env


def placed(env, at, velocity=(0.0, 0.0)):
    """The constraint, with the ball somewhere."""
    env.unwrapped.place(at, velocity)
    env.plant.observe()
    return Asked(env.constraints[0], env.plant)


ENVS = {
    "clip known": (5.0, dict(velocity_clip=5.0), 1),
    "clip not known": (1.3, {}, 1),
    "four physics steps": (None, {}, 4),
}


@pytest.fixture(scope="module", params=ENVS)
def world(request):
    clip, options, substeps = ENVS[request.param]
    return filtered(PointWorld(substeps, clip), **options)


PLACES = st.tuples(st.floats(-1.9, 1.9), st.floats(-1.9, 1.9))
SPEEDS = st.tuples(st.floats(-6.0, 6.0), st.floats(-6.0, 6.0))
ACTIONS = st.lists(
    st.tuples(st.sampled_from([-1.0, 0.0, 1.0, 0.37]), st.sampled_from([-0.8, 0.0, 1.0, -0.2])),
    min_size=1,
    max_size=12,
)


@given(PLACES, SPEEDS, ACTIONS, st.integers(1, 5))
def test_from_every_safe_state_any_actions_stay_clear_in_mujoco(world, at, velocity, actions, hold):
    limit = placed(world, at, velocity)
    assume(limit.least >= limit.spec.margin)
    for action in actions:
        for _ in range(hold):
            info = world.step(np.array(action, np.float32))[4]
            assert not info["touched"]
            assert info["nearest"] >= MARGIN + 0.004 - 1e-6
            assert not (info["cbf/infeasible"] or info["cbf/fallback"] or info["cbf/unsafe"])
            world.plant.observe()
            assert limit.least >= limit.spec.margin - 1e-7


@pytest.mark.parametrize("options", [{"velocity_clip": 5.0}, {}])
def test_a_hair_lost_to_rounding_is_no_reason_to_refuse_braking(options):
    limit = placed(filtered(**options), (2.0 - ROOM + 5e-8, -1.2), (0.0, 1.0))
    assert limit.least < limit.spec.margin
    assert limit.admits(limit.backup())
    assert limit.admits(np.array([0.0, 1.0]))  # along the wall
    assert limit.admits(np.array([-1.0, 0.0]))  # away from it
    assert not limit.admits(np.array([1e-4, 0.0]))


def test_the_nearest_admitted_control_is_found():
    # Against every control of a fine grid, at states that a rough driver comes to.
    env = filtered(PointWorld(clip=5.0))
    limit = Asked(env.constraints[0], env.plant)
    grid = np.array([(x, y) for x in np.linspace(-1, 1, 41) for y in np.linspace(-0.8, 1, 37)])
    rng = np.random.default_rng(0)
    checked = 0
    while checked < 40:
        action = rng.choice([-1.0, 1.0], 2) * [1.0, 0.8]
        for _ in range(15):
            env.plant.observe()
            if not limit.admits(action) and rng.random() < 0.2:
                best, other = limit.candidates(action)
                assert limit.admits(best) and limit.admits(other)
                assert np.linalg.norm(best - action) <= np.linalg.norm(other - action)
                distance = np.linalg.norm(grid - action, axis=1)
                order = np.argsort(distance)
                found = next(k for k in order if limit.admits(grid[k]))
                assert np.linalg.norm(best - action) <= distance[found] + 1e-6
                checked += 1
            env.step(action.astype(np.float32))


@pytest.mark.parametrize("options", [{"velocity_clip": 5.0}, {}])
@pytest.mark.parametrize(("gap", "asked", "lost"), [(0.03, (-1.0, 0.3), False), (0.001, (1.0, 0.0), True)])
def test_from_inside_the_margin_and_from_the_wall_it_comes_back_and_stays(options, gap, asked, lost):
    env = filtered(margin=0.05, **options)
    placed(env, (2.0 - RADIUS - gap, -1.2))
    with warnings.catch_warnings(action="ignore"):
        infos = [env.step(np.array(asked, np.float32))[4] for _ in range(200)]
    margins = np.array([info["cbf/margin"] for info in infos])
    assert infos[0]["cbf/unsafe"] == lost and not infos[-1]["cbf/unsafe"]
    assert margins.min() >= margins[0] - 1e-9 and margins[120:].min() >= 0.05 - 1e-6


@pytest.mark.parametrize(
    ("at", "velocity", "asked"),
    [((-0.06, 0.05), (4.4, -3.6), (0.6, -0.5)), ((0.21, -0.16), (-2.0, 1.7), (0.0, 0.6))],
)
def test_beside_a_corner_both_orders_are_tried_and_without_a_known_clip_the_rectangle_counts(
    at, velocity, asked
):
    limit = placed(filtered(velocity_clip=5.0), at, velocity)
    near, far = (np.linalg.norm(control - asked) for control in limit.candidates(np.array(asked)))
    assert near < far - 0.1 and limit.least > limit.spec.margin
    assert placed(filtered(), at, velocity).least < 0.0
