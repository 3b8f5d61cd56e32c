"""Clearance, TrackPermission and Barrier: rows against finite differences, and closed loops."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from asking import Asked, asked, pushed
from judged_loops import slider
from scenes import Scene

import safe_wrappers as sw
from safe_wrappers import constraints as of
from safe_wrappers.control.backup.stopping import held_limit
from safe_wrappers.errors import ConfigurationError, UnknownNameError
from safe_wrappers.filter.bound import Bound

POINT_MASS = """<mujoco><option timestep="{timestep}" gravity="{pull}" integrator="RK4"/>
<worldbody><body name="ball">
<joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>
<geom type="sphere" size="0.05" mass="2" contype="0" conaffinity="0"/>
<site name="nose" pos="0.05 0 0"/></body></worldbody><actuator>
<motor joint="x" gear="4" ctrlrange="-1 1"/><motor joint="y" gear="4" ctrlrange="-1 1"/></actuator></mujoco>"""


class PointMass(Scene):
    """2 kg in the plane, pushed by up to 4 N along each axis; keeps every physics substep's position."""

    def __init__(self, timestep=0.002, frame_skip=10, pull=(0.0, 0.0)):
        super().__init__(POINT_MASS.format(timestep=timestep, pull=f"{pull[0]} {pull[1]} 0"), frame_skip)

    def reset(self, *, seed=None, options=None):
        self.path = [np.zeros(2)]
        return super().reset(seed=seed)

    def place(self, qpos, qvel):
        self.data.qpos[:], self.data.qvel[:] = qpos, qvel

    def step(self, action):
        self.data.ctrl[:] = action
        for _ in range(self.frame_skip):
            mujoco.mj_step(self.model, self.data)
            self.path.append(self.data.qpos.copy())
        return np.zeros(1), 0.0, False, False, {}


DISCS = [
    of.Disc([1.0, 0.3], 0.3),
    of.Disc([1.0, -0.9], 0.4),
    of.Disc([-1.2, 0.0], 0.5),
    of.Disc([0.0, 1.4], 0.3),
]


def gap(path):
    return min(float((np.linalg.norm(np.array(path) - d.center, axis=1) - d.radius).min()) for d in DISCS)


BALL, NOSE = {"bodies": ["ball"]}, {"sites": ["nose"], "geoms": []}
SURFACES = {
    "a disc": (DISCS[0], BALL, lambda p: np.linalg.norm(p - [1.0, 0.3]) - 0.3),
    "a sphere": (
        of.Sphere([1.0, 0.3, 0.4], 0.5),
        NOSE,
        lambda p: np.hypot(np.hypot(*(p - [1.0, 0.3])), 0.4) - 0.5,
    ),
    "a box": (of.Box([1.0, 0.3], [0.3, 0.9]), NOSE, lambda p: 0.7 - p[0]),
}


@pytest.mark.parametrize("surface", SURFACES)
def test_rows_are_the_second_derivative_of_the_distance(surface):
    pull, hold = np.array([0.4, -0.7]), 0.02  # a drift
    obstacle, point, distance_from = SURFACES[surface]
    offset = np.array([0.05 if point is NOSE else 0.0, 0.0])
    env = PointMass(pull=pull)
    clear = asked(env, of.Clearance([obstacle], 1.5, radius=0.05, margin=0.3, state_error=0.1, **point))
    rng, compared = np.random.default_rng(0), 0
    for _ in range(60):
        env.place(np.array([0.2, 0.1]) - offset + rng.uniform(-0.1, 0.1, 2), rng.uniform(-1, 1, 2))
        clear.plant.observe()
        u = rng.uniform(-1, 1, 2)
        p, v, a, step = env.data.qpos + offset, env.data.qvel, 2.0 * u + pull, 1e-4
        before, now, after = (distance_from(p + v * t + 0.5 * a * t**2) for t in (-step, 0.0, step))
        approach, acceleration = -(after - before) / (2 * step), -(after - 2 * now + before) / step**2
        room, speed = clear.spec.approach()
        assert room[0] == pytest.approx(now - 0.05, abs=1e-9) and speed[0] == pytest.approx(
            approach, abs=1e-6
        )
        way = max(approach, 0.0) ** 2 / 3.0  # held braking takes up to brake hold^2 / 8 more
        assert now - 0.05 - way - 1.5 * hold**2 / 8 - 1e-6 <= clear.value()[0] <= now - 0.05 - way + 1e-6
        rows, limit = clear.rows(), held_limit(now - 0.05 - 0.4, approach, 1.5, hold)
        if len(rows.offsets) and limit > -1e6:
            compared += 1
            assert rows.offsets[0] - rows.normals[0] @ u == pytest.approx(limit - acceleration, abs=1e-4)
    assert compared > 10


@pytest.mark.parametrize("frame_skip", [25, 5])
def test_a_mujoco_point_mass_that_drives_at_the_nearest_disc_never_enters_one(frame_skip):
    # 2 N along any direction is 2 m/s^2 at least; braking is declared below it. The margin is for the turn of
    # the direction within a hold.
    env = PointMass(frame_skip=frame_skip)
    filtered = sw.CBFActionFilter(env, [of.Clearance(DISCS, braking=1.5, margin=0.01, **BALL)])
    filtered.reset(seed=0)
    for _ in range(int(8.0 / env.dt)):
        away = np.array([d.center for d in DISCS]) - env.data.qpos
        filtered.step(np.clip(3.0 * min(away, key=np.linalg.norm), -1, 1))
    assert 0.0 < gap(env.path) < 0.05  # and it is not kept away for nothing


MASS = {"bodies": ["b0"], "margin": 2e-3}


class Chased(Scene):
    """A mass on a line and a disc that drives at it at 0.4 m/s, whose place and velocity are published."""

    speeds, closest = np.array([[-0.4, 0.0]]), np.inf

    def reset(self, *, seed=None, options=None):
        self.discs = np.array([[3.0, 0.0]])
        return super().reset(seed=seed)

    def step(self, action):
        answer = super().step(action)
        self.discs = self.discs + self.dt * self.speeds
        self.closest = min(self.closest, self.discs[0, 0] - self.data.qpos[0] - 0.5)
        return answer


@pytest.mark.parametrize("policy", [1.0, 0.0])
def test_a_published_moving_disc_is_evaded(policy):
    def closest(**published):
        env, clear = Chased(slider().xml), of.Clearance([of.Discs("discs", 0.5, **published)], 0.99, **MASS)
        filtered = sw.CBFActionFilter(env, [clear])
        filtered.reset(seed=0)
        for _ in range(160):
            filtered.step(np.array([policy]))
        return env.closest

    assert 0.0 <= closest(velocity_attribute="speeds") < 0.05
    assert closest() < 0.0  # taken for standing still it runs the mass over: the test has teeth


# TrackPermission ----------------------------------------------------------------------------------------------

NOTHING_SEEN = sw.occlusion.Sensor("eye", range_m=0.01)
FAR_CARS = {"layout": {"cars": [[-9.0 - i, 0.0] for i in range(6)], "agent": [0.0, 1.0, 0.0]}}


def permitted(tolerance, known, **options):
    inside = sw.OcclusionPenalty(gym.make("OccludedCrossing-v0"), known, NOTHING_SEEN, tolerance)
    return sw.CBFActionFilter(inside, [of.TrackPermission("robot", 3.0, **options)])


def test_when_they_expire_it_slows_down_as_declared_and_turns_as_it_likes():
    env = permitted(
        0.45,
        [sw.occlusion.Track("car*", acceleration_noise=0.1, start_position_std=0.1, start_velocity_std=0.0)],
    )
    env.reset(seed=0, options=FAR_CARS)
    speed, stopped_for, expired = 0.0, 0, False
    for k in range(110):
        info = env.step(np.array([0.3, 0.0 if k < 5 else -0.9, 1.0], np.float32))[4]
        now = float(np.linalg.norm(env.unwrapped.agent_velocity))
        assert not info["cbf/infeasible"] and not info["cbf/fallback"]
        if expired:
            # 3 m/s^2 over 0.04 s, up to what damping adds within the held step.
            assert now <= max(speed - 3.0 * 0.04, 0.0) + 0.02, (k, now, speed)
            assert info["executed_action"][2] == 1.0
            stopped_for += now <= 1e-3
        speed, expired = now, bool(info["occlusion/expired"].any())
    assert stopped_for > 10 and abs(env.unwrapped.data.qvel[2]) > 3.0


@pytest.mark.parametrize(("tracks", "stops"), [(["car1", "car4"], False), (["car0"], True), (None, True)])
def test_only_the_tracks_that_count_stop_it(tracks, stops):
    unsure = sw.occlusion.Track("car0", acceleration_noise=1.0, start_position_std=2.0)
    sure = sw.occlusion.Track(
        "car[1-5]", acceleration_noise=0.0, start_position_std=0.01, start_velocity_std=0.0
    )
    env = permitted(0.5, [unsure, sure], tracks=tracks)
    env.reset(seed=0)
    for _ in range(10):
        info = env.step(np.array([0.0, 1.0, 0.0]))[4]
    assert info["occlusion/expired"].tolist() == [True] + 5 * [False]
    assert info["cbf/intervened"] == stops
    with pytest.raises(UnknownNameError, match="no track 'car9'; there are car0"):
        permitted(0.5, [unsure, sure], tracks=["car9"])


# Barrier ------------------------------------------------------------------------------------------------------


def observed(x):
    """A plant of x' = -x^2 + (4 + x) u in the state x: scalar, so everything can be checked by hand."""
    f, g = lambda x: -(x**2), lambda x: np.array([[4.0 + x[0]]])
    plant = sw.AnalyticPlant(f, g, lambda env: np.array([x]), control_dt=0.05)
    plant.bind(slider())
    plant.observe()
    return plant


def h(x):
    return 1.0 - x[0] ** 2


@pytest.mark.parametrize("x", [-0.8, -0.1, 0.3, 0.9])
def test_row_is_the_barrier_condition(x):
    barrier = Asked(of.Barrier(h, alpha=3.0, margin=0.05), observed(x))
    rows, step = barrier.rows(), 1e-6
    for u in (-0.7, 0.2, 1.0):
        rate = (h([x + step * (-(x**2) + (4 + x) * u)]) - h([x])) / step
        assert rows.offsets[0] - rows.normals[0] @ [u] == pytest.approx(
            rate + 3.0 * (h([x]) - 0.05), abs=1e-4
        )
    np.testing.assert_allclose(barrier.value(), [h([x])])


def slider_filter(h, **options):
    plant = pushed(lambda env: np.concatenate([env.data.qpos, env.data.qvel]), control_dt=0.05)
    return sw.CBFActionFilter(slider(), [of.Barrier(h, **options)], plant=plant)


@pytest.mark.parametrize("unit", [1e-9, 1e3])
def test_the_unit_of_h_does_not_matter(unit):
    def driven(unit):
        """What is executed, and h in its unit, under a policy that heads for a speed beyond the limit."""
        filtered, seen = slider_filter(lambda x: unit * (0.25 - x[1] ** 2), alpha=2.0), []
        filtered.reset(seed=0)
        for _ in range(20):
            info = filtered.step(np.array([0.9]))[4]
            assert not info["cbf/fallback"]
            seen.append((info["executed_action"][0], info["cbf/margin"] / unit, info["cbf/intervened"]))
        return np.array(seen, dtype=float)

    one = driven(1.0)
    assert 0 < one[:, 2].sum() < 20 and one[:, 1].min() > -1e-6
    np.testing.assert_allclose(driven(unit), one, atol=1e-5)
    with pytest.raises(ConfigurationError, match="no control acts on it"):
        slider_filter(lambda x: unit).reset(seed=0)
    with pytest.raises(
        ConfigurationError, match=r"relative degree is 2.*put the braking distance into h.*Clearance"
    ):
        slider_filter(lambda x: unit * (1.0 - x[0])).reset(seed=0)


def test_a_decay_that_outruns_the_hold_is_refused():
    Bound(of.Barrier(h, alpha=20.0), observed(0.0))
    with pytest.raises(
        ConfigurationError, match=r"alpha = 20.1/s .* zero within one hold of 0.05 s; .* 20/s"
    ):
        Bound(of.Barrier(h, alpha=20.1), observed(0.0))
