"""Clearance: its rows against finite differences and simulation, closed loops on a line and in MuJoCo's plane."""

import warnings

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from asking import Asked, bound
from gymnasium.envs.mujoco import MujocoEnv

import safe_wrappers as sw
from safe_wrappers.control.backup.stopping import held_limit, held_stop
from safe_wrappers.errors import ConfigurationError

POINT_MASS = """<mujoco><option timestep="{timestep}" gravity="{pull}" integrator="RK4"/>
<worldbody><body name="ball">
<joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>
<geom type="sphere" size="0.05" mass="2" contype="0" conaffinity="0"/>
<site name="nose" pos="0.05 0 0"/></body></worldbody><actuator>
<motor joint="x" gear="4" ctrlrange="-1 1"/><motor joint="y" gear="4" ctrlrange="-1 1"/></actuator></mujoco>"""


class PointMass(MujocoEnv):
    """2 kg in the plane, pushed by up to 4 N along each axis; keeps every physics substep's position."""

    metadata = {"render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"], "render_fps": 50}  # noqa: RUF012

    def __init__(self, folder, timestep=0.002, frame_skip=10, pull=(0.0, 0.0)):
        path = folder / "point_mass.xml"
        path.write_text(POINT_MASS.format(timestep=timestep, pull=f"{pull[0]} {pull[1]} 0"))
        self.metadata = {**self.metadata, "render_fps": round(1.0 / (timestep * frame_skip))}
        space = gym.spaces.Box(-np.inf, np.inf, (4,), np.float64)
        super().__init__(str(path), frame_skip, space)

    def reset_model(self):
        self.set_state(self.init_qpos, self.init_qvel)
        self.path = []
        return np.concatenate([self.data.qpos, self.data.qvel])

    def step(self, action):
        self.data.ctrl[:] = action
        for _ in range(self.frame_skip):
            mujoco.mj_step(self.model, self.data)
            self.path.append(self.data.qpos.copy())
        return np.concatenate([self.data.qpos, self.data.qvel]), 0.0, False, False, {}


DISCS = [
    sw.constraints.Disc([1.0, 0.3], 0.3),
    sw.constraints.Disc([1.0, -0.9], 0.4),
    sw.constraints.Disc([-1.2, 0.0], 0.5),
    sw.constraints.Disc([0.0, 1.4], 0.3),
]


def gap(path):
    return min(float((np.linalg.norm(np.array(path) - d.center, axis=1) - d.radius).min()) for d in DISCS)


@pytest.mark.parametrize("kind", ["bodies", "sites"])
def test_rows_are_the_second_derivative_of_the_distance(tmp_path, kind):
    pull = np.array([0.4, -0.7])  # a drift
    env = PointMass(tmp_path, pull=pull)
    env.reset(seed=0)
    plant = bound(env)
    name, offset = {"bodies": ("ball", 0.0), "sites": ("nose", 0.05)}[kind]
    clear = sw.constraints.Clearance([DISCS[0]], braking=1.5, **{kind: [name]})
    clear = Asked(clear, plant)
    rng = np.random.default_rng(0)
    compared = 0
    for _ in range(200):
        env.set_state(np.array([0.55 - offset, 0.1]) + rng.uniform(-0.1, 0.1, 2), rng.uniform(-1, 1, 2))
        plant.observe()
        u = rng.uniform(-1, 1, 2)
        p, v, a = env.data.qpos + np.array([offset, 0.0]), env.data.qvel, 2.0 * u + pull

        def distance(t, p=p, v=v, a=a):
            return np.linalg.norm(p + v * t + 0.5 * a * t**2 - DISCS[0].center) - DISCS[0].radius

        step = 1e-4
        approach = -(distance(step) - distance(-step)) / (2 * step)
        acceleration = -(distance(step) - 2 * distance(0.0) + distance(-step)) / step**2
        way = max(approach, 0.0) ** 2 / 3.0  # held braking takes up to brake hold^2 / 8 more
        value = clear.value()[0]
        assert distance(0.0) - way - 1.5 * 0.02**2 / 8 - 1e-6 <= value <= distance(0.0) - way + 1e-6
        rows = clear.rows()
        if not len(rows.offsets):
            continue
        compared += 1
        limit = held_limit(distance(0.0), approach, 1.5, plant.control_dt)
        if limit > -1e6:
            assert rows.offsets[0] - rows.normals[0] @ u == pytest.approx(limit - acceleration, abs=1e-4)
    assert compared > 20


def drivers():
    def blind(env, rng, k):
        return np.array([1.0, 0.0])

    def diagonal(env, rng, k):
        return np.array([1.0, 0.35])

    def bang_bang(env, rng, k):
        return np.sign(np.random.default_rng(k // 40).normal(size=2))

    def hunter(env, rng, k):
        offsets = np.array([d.center for d in DISCS]) - env.data.qpos
        return np.clip(3.0 * offsets[np.argmin(np.linalg.norm(offsets, axis=1))], -1, 1)

    def orbit(env, rng, k):
        offset = np.array(DISCS[2].center) - env.data.qpos
        away = offset / np.linalg.norm(offset)
        return np.clip(2.0 * offset - 1.5 * env.data.qvel + 3.0 * np.array([-away[1], away[0]]), -1, 1)

    return [blind, diagonal, bang_bang, hunter, orbit]


@pytest.mark.parametrize("frame_skip", [5, 25])
@pytest.mark.parametrize("driver", drivers(), ids=lambda d: d.__name__)
def test_a_mujoco_point_mass_never_enters_a_disc(tmp_path, driver, frame_skip):
    # 2 N along any direction is 2 m/s^2 at least; braking is declared below it. The margin is for the turn of
    # the direction within a hold.
    env = PointMass(tmp_path, frame_skip=frame_skip)
    clear = sw.constraints.Clearance(DISCS, braking=1.5, bodies=["ball"], margin=0.01)
    filtered = sw.CBFActionFilter(env, [clear])
    rng = np.random.default_rng(0)
    closest, infeasible, intervened = np.inf, 0, 0
    for seed in range(2):
        filtered.reset(seed=seed)
        env.path = [env.data.qpos.copy()]
        for k in range(int(8.0 / env.dt)):
            info = filtered.step(driver(env, rng, k).astype(np.float32))[4]
            infeasible += info["cbf/infeasible"]
            intervened += info["cbf/intervened"]
        closest = min(closest, gap(env.path))
    assert closest > 0.0, (driver.__name__, frame_skip, closest)
    assert intervened > 0
    if driver.__name__ == "hunter":
        assert closest < 0.05  # and it is not kept away for nothing


@pytest.mark.parametrize("radius", [0.0, 0.05])
@pytest.mark.parametrize("state_error", [0.0, 0.02])
def test_radius_margin_and_state_error_add_up(tmp_path, radius, state_error):
    env = PointMass(tmp_path)
    wall = sw.constraints.Plane([1.0], [-1.0])
    clear = sw.constraints.Clearance(
        [wall], 1.5, bodies=["ball"], radius=radius, margin=0.03, state_error=state_error
    )
    filtered = sw.CBFActionFilter(env, [clear])
    filtered.reset(seed=0)
    for _ in range(300):
        filtered.step(np.array([1.0, 0.0], np.float32))
    farthest = max(p[0] for p in env.path)
    assert farthest == pytest.approx(1.0 - radius - 0.03 - state_error, abs=2e-3)
    assert farthest <= 1.0 - radius - 0.03 - state_error + 1e-6


def test_spheres_and_boxes_around_an_arm():
    # Reacher's fingertip against a pillar: best effort, so the truth is only asked not to get worse than the
    # unfiltered arm, and the infeasible steps to be told.
    pillar = sw.constraints.Box([0.12, 0.12], [0.03, 0.03])
    clear = sw.constraints.Clearance(
        [pillar, sw.constraints.Sphere([-0.15, 0.0, 0.01], 0.04)],
        braking=3.0,
        bodies=["fingertip"],
        margin=0.01,
    )

    def deepest(env, filtered):
        rng = np.random.default_rng(0)
        worst = np.inf
        for seed in range(3):
            env.reset(seed=seed)
            for k in range(150):
                if k % 15 == 0:
                    action = rng.uniform(-0.4, 0.4, 2).astype(np.float32)
                env.step(action)
                raw = env.unwrapped
                mujoco.mj_kinematics(raw.model, raw.data)
                p = raw.data.body("fingertip").xpos
                worst = min(worst, *(o.nearest(p, None).distance[0] for o in clear.obstacles))
        return worst

    with warnings.catch_warnings(action="ignore"):
        kept = deepest(sw.CBFActionFilter(gym.make("Reacher-v5"), [clear]), True)
    bare = deepest(gym.make("Reacher-v5"), False)
    assert bare < -0.01
    assert kept > bare


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"obstacles": []}, "obstacles is a list with at least one obstacle"),
        ({"braking": -2}, r"braking must be a finite number > 0 in m/s\^2, got -2"),
        ({"state_error": np.nan}, "state_error must be a finite number >= 0 in m, got nan"),
        ({"position": [0] * 4, "velocity": [1] * 4}, "position and velocity are up to three"),
    ],
)
def test_constructor_refuses_nonsense(arguments, message):
    with pytest.raises(ConfigurationError, match=message):
        sw.constraints.Clearance(
            **{"obstacles": [sw.constraints.Disc([0, 0], 1)], "braking": 1.0, **arguments}
        )


@pytest.mark.parametrize("frame", [{"bodies": ["ball"]}, {"sites": ["nose"], "geoms": []}])
def test_approach_is_what_the_barrier_counts_the_stopping_distance_from(tmp_path, frame):
    env = PointMass(tmp_path)
    plant = bound(env)
    clearance = sw.constraints.Clearance(
        DISCS, braking=2.0, radius=0.05, margin=0.3, state_error=0.1, **frame
    )
    clearance = Asked(clearance, plant)
    env.reset(seed=0)
    env.set_state(np.array([0.2, -0.1]), np.array([0.7, -0.4]))
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
