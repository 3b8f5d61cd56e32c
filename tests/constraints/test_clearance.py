"""Clearance: its rows against finite differences and simulation, closed loops on a line and in MuJoCo's plane."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from asking import Asked, bound
from scenes import Scene

import safe_wrappers as sw
from safe_wrappers.control.backup.stopping import held_limit, held_stop
from safe_wrappers.errors import UnknownNameError

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
    sw.constraints.Disc([1.0, 0.3], 0.3),
    sw.constraints.Disc([1.0, -0.9], 0.4),
    sw.constraints.Disc([-1.2, 0.0], 0.5),
    sw.constraints.Disc([0.0, 1.4], 0.3),
]


def gap(path):
    return min(float((np.linalg.norm(np.array(path) - d.center, axis=1) - d.radius).min()) for d in DISCS)


SURFACES = {
    "a disc": (DISCS[0], lambda p: np.linalg.norm(p - [1.0, 0.3]) - 0.3),
    "a sphere": (
        sw.constraints.Sphere([1.0, 0.3, 0.4], 0.5),
        lambda p: np.hypot(np.hypot(*(p - [1.0, 0.3])), 0.4) - 0.5,
    ),
    "a box": (sw.constraints.Box([1.0, 0.3], [0.3, 0.9]), lambda p: 0.7 - p[0]),
}


@pytest.mark.parametrize("surface", SURFACES)
@pytest.mark.parametrize(("kind", "offset"), [({"bodies": ["ball"]}, 0.0), ({"sites": ["nose"]}, 0.05)])
def test_rows_are_the_second_derivative_of_the_distance(kind, offset, surface):
    pull = np.array([0.4, -0.7])  # a drift
    obstacle, distance_from = SURFACES[surface]
    env = PointMass(pull=pull)
    env.reset(seed=0)
    plant = bound(env)
    clear = Asked(sw.constraints.Clearance([obstacle], braking=1.5, **kind), plant)
    rng, compared = np.random.default_rng(0), 0
    for _ in range(100):
        env.place(np.array([0.55 - offset, 0.1]) + rng.uniform(-0.1, 0.1, 2), rng.uniform(-1, 1, 2))
        plant.observe()
        u = rng.uniform(-1, 1, 2)
        p, v, a = env.data.qpos + np.array([offset, 0.0]), env.data.qvel, 2.0 * u + pull
        step = 1e-4
        before, now, after = (distance_from(p + v * t + 0.5 * a * t**2) for t in (-step, 0.0, step))
        approach = -(after - before) / (2 * step)
        acceleration = -(after - 2 * now + before) / step**2
        way = max(approach, 0.0) ** 2 / 3.0  # held braking takes up to brake hold^2 / 8 more
        value = clear.value()[0]
        assert now - way - 1.5 * 0.02**2 / 8 - 1e-6 <= value <= now - way + 1e-6
        rows = clear.rows()
        limit = held_limit(now, approach, 1.5, plant.control_dt)
        if len(rows.offsets) and limit > -1e6:
            compared += 1
            assert rows.offsets[0] - rows.normals[0] @ u == pytest.approx(limit - acceleration, abs=1e-4)
    assert compared > 10


def hunter(env, k):
    offsets = np.array([d.center for d in DISCS]) - env.data.qpos
    return np.clip(3.0 * offsets[np.argmin(np.linalg.norm(offsets, axis=1))], -1, 1)


def orbit(env, k):
    offset = np.array(DISCS[2].center) - env.data.qpos
    away = offset / np.linalg.norm(offset)
    return np.clip(2.0 * offset - 1.5 * env.data.qvel + 3.0 * np.array([-away[1], away[0]]), -1, 1)


DRIVERS = {
    "blind": lambda env, k: np.array([1.0, 0.0]),
    "diagonal": lambda env, k: np.array([1.0, 0.35]),
    "bang-bang": lambda env, k: np.sign(np.random.default_rng(k // 40).normal(size=2)),
    "hunter": hunter,
    "orbit": orbit,
}


@pytest.mark.parametrize(
    ("driver", "frame_skip"), [*((driver, 25) for driver in DRIVERS), ("hunter", 5), ("orbit", 5)]
)
def test_a_mujoco_point_mass_never_enters_a_disc(driver, frame_skip):
    # 2 N along any direction is 2 m/s^2 at least; braking is declared below it. The margin is for the turn of
    # the direction within a hold.
    env = PointMass(frame_skip=frame_skip)
    clear = sw.constraints.Clearance(DISCS, braking=1.5, bodies=["ball"], margin=0.01)
    filtered, intervened = sw.CBFActionFilter(env, [clear]), 0
    filtered.reset(seed=0)
    for k in range(int(8.0 / env.dt)):
        intervened += filtered.step(DRIVERS[driver](env, k))[4]["cbf/intervened"]
    closest = gap(env.path)
    assert closest > 0.0 and intervened > 0
    assert driver != "hunter" or closest < 0.05  # and it is not kept away for nothing


@pytest.mark.parametrize("radius", [0.0, 0.05])
@pytest.mark.parametrize("state_error", [0.0, 0.02])
def test_radius_margin_and_state_error_add_up(radius, state_error):
    env = PointMass()
    wall = sw.constraints.Plane([1.0], [-1.0])
    clear = sw.constraints.Clearance(
        [wall], 1.5, bodies=["ball"], radius=radius, margin=0.03, state_error=state_error
    )
    filtered = sw.CBFActionFilter(env, [clear])
    filtered.reset(seed=0)
    for _ in range(300):
        filtered.step(np.array([1.0, 0.0]))
    farthest = max(p[0] for p in env.path)
    assert farthest == pytest.approx(1.0 - radius - 0.03 - state_error, abs=2e-3)
    assert farthest <= 1.0 - radius - 0.03 - state_error + 1e-6


@pytest.mark.parametrize("frame", [{"bodies": ["ball"]}, {"sites": ["nose"], "geoms": []}])
def test_approach_is_what_the_barrier_counts_the_stopping_distance_from(frame):
    env = PointMass()
    plant = bound(env)
    clearance = sw.constraints.Clearance(
        DISCS, braking=2.0, radius=0.05, margin=0.3, state_error=0.1, **frame
    )
    clearance = Asked(clearance, plant)
    env.reset(seed=0)
    env.place(np.array([0.2, -0.1]), np.array([0.7, -0.4]))
    plant.observe()
    room, speed = clearance.spec.approach()
    point = np.array([0.2, -0.1]) + (np.array([0.05, 0.0]) if "sites" in frame else 0.0)
    for i, disc in enumerate(DISCS):
        way = np.asarray(disc.center)[:2] - point
        distance = np.linalg.norm(way)
        assert room[i] == pytest.approx(distance - disc.radius - 0.05, abs=1e-12)
        assert speed[i] == pytest.approx(np.array([0.7, -0.4]) @ way / distance, abs=1e-12)
    stops = [held_stop(v, 2.0, env.dt) for v in speed]
    assert clearance.value() == pytest.approx(room - stops, abs=1e-12)


# Moving obstacles ---------------------------------------------------------------------------------------------


class Chaser(gym.Env):
    """A cart at rest on a line with a disc that drives at it; the disc's place is published."""

    dt = 0.1
    action_space = gym.spaces.Box(-1, 1, (1,), np.float64)
    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = np.zeros(4)  # x, y, vx, vy
        self.discs, self.speeds = np.array([[3.0, 0.0]]), np.array([[-0.4, 0.0]])
        self.elapsed, self.closest = 0.0, np.inf
        return self.state[:2].astype(np.float32), {}

    def step(self, action):
        a = float(action[0])
        for t in np.linspace(0.0, self.dt, 11)[1:]:
            x = self.state[0] + self.state[2] * t + 0.5 * a * t**2
            self.closest = min(self.closest, abs(self.discs[0, 0] + self.speeds[0, 0] * t - x) - 0.5)
        self.state = self.state + np.array(
            [self.state[2] * self.dt + 0.5 * a * self.dt**2, 0.0, a * self.dt, 0.0]
        )
        self.discs = self.discs + self.speeds * self.dt
        return self.state[:2].astype(np.float32), 0.0, False, False, {}


def chase(obstacle, policy):
    plant = sw.AnalyticPlant(
        f=lambda x: np.array([x[2], x[3], 0.0, 0.0]),
        g=lambda x: np.array([[0.0], [0.0], [1.0], [0.0]]),
        state=lambda env: env.state,
        control_dt=0.1,
    )
    clear = sw.constraints.Clearance([obstacle], braking=1.0, position=[0, 1], velocity=[2, 3], margin=1e-3)
    env = sw.CBFActionFilter(Chaser(), [clear], plant=plant)
    env.reset(seed=0)
    for _ in range(80):
        env.step(np.array([policy]))
    return env.unwrapped.closest


@pytest.mark.parametrize("policy", [1.0, 0.0])
def test_a_published_moving_disc_is_evaded(policy):
    closest = chase(sw.constraints.Discs("discs", 0.5, velocity_attribute="speeds"), policy)
    assert 0.0 <= closest < 0.05
    blind = chase(sw.constraints.Discs("discs", 0.5), policy)
    assert blind < 0.0  # taken for standing still it runs the cart over: the test has teeth


# TrackPermission ----------------------------------------------------------------------------------------------

NOTHING_SEEN = sw.occlusion.Sensor("eye", range_m=0.01)
FAR_CARS = {"layout": {"cars": [[-9.0 - i, 0.0] for i in range(6)], "agent": [0.0, 1.0, 0.0]}}


def permitted(tolerance, known, **options):
    inside = sw.OcclusionPenalty(gym.make("OccludedCrossing-v0"), known, NOTHING_SEEN, tolerance)
    return sw.CBFActionFilter(inside, [sw.constraints.TrackPermission("robot", 3.0, **options)])


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


@pytest.mark.parametrize(
    ("body", "tracks", "words"),
    [("robot", ["car9"], "no track 'car9'; there are car0"), ("robo", None, "robo")],
)
def test_names_that_are_not_there_are_refused(body, tracks, words):
    sure = sw.occlusion.Track("car*", acceleration_noise=0.0)
    inside = sw.OcclusionPenalty(gym.make("OccludedCrossing-v0"), [sure], NOTHING_SEEN, 1.0)
    with pytest.raises(UnknownNameError, match=words):
        sw.CBFActionFilter(inside, [sw.constraints.TrackPermission(body, 3.0, tracks=tracks)])
