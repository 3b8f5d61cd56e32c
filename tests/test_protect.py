"""protect: the recommended stack for known envs, and lines that work for the others."""

import textwrap
import warnings
from unittest import mock

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from scenes import make

import safe_wrappers as sw
from benchmarks import shelf
from benchmarks.cases import PROTECTED
from safe_wrappers.envs import SPEED_LIMITS
from safe_wrappers.envs.goal_env import HAZARD_RADIUS
from safe_wrappers.envs.goal_robots import CAR
from safe_wrappers.errors import ConfigurationError, UnknownNameError, UnsupportedEnvError
from safe_wrappers.wrappers.recipes import VASE_HULL_RADIUS_M

RUNNERS = ["HalfCheetah", "Hopper", "Walker2d", "Swimmer", "Ant", "Humanoid"]
KNOWN = sorted({env_id for case in PROTECTED.values() for env_id in (case.env_id, *case.also)})
TOUCHING = ("FetchPush", "FetchSlide")
"""Their own resets put the fingers 3 mm into the table."""


@pytest.mark.parametrize("env_id", KNOWN)
def test_known_envs_get_a_filter_that_passes_gymnasiums_checks(env_id):
    env = sw.protect(make(env_id))
    assert isinstance(env, sw.CBFActionFilter) and env.constraints
    if "DoublePendulum" in env_id:  # no driver gets to the end of its rail
        assert [type(c).__name__ for c in env.constraints] == ["Clearance", "JointPositionLimit"]
    again = gym.make(EnvSpec.from_json(env.spec.to_json()), disable_env_checker=True)
    assert isinstance(again, sw.CBFActionFilter) and again.constraints == env.constraints
    assert again.constraint_names == env.constraint_names
    expected = "A Box observation space|is different from the unwrapped|symmetric and normalized|out of date"
    if env_id.startswith(TOUCHING):
        expected += "|outside the safe set"
    with warnings.catch_warnings(action="error"):
        warnings.filterwarnings("ignore", message=f".*({expected})")
        check_env(env, skip_render_check=True)


@pytest.mark.parametrize("robot", RUNNERS)
def test_runners_keep_the_limit_that_their_task_publishes(robot):
    task = make(f"Safe{robot}Velocity-v0")
    names = f"{robot}-v4", f"{robot}-v5", f"Safe{robot}Velocity-v0"
    limit, *others = (sw.protect(make(env_id)).constraints[0] for env_id in names)
    assert others == [limit, limit]
    assert limit.limit == task.unwrapped.speed_limit == SPEED_LIMITS[robot]
    assert 0.0 < limit.margin < 0.05 * limit.limit and limit.average == "step"
    # as the task measures: along x, but in the plane for two of them, and Humanoid's centre of mass
    assert limit.direction == ("xy" if robot in ("Ant", "Humanoid") else "+x")
    assert limit.body == (None if robot == "Humanoid" else "torso")


def test_an_ant_keeps_out_of_its_mazes_blocks_and_of_nothing_else():
    env = sw.protect(make("AntMaze_UMaze-v5"))
    model, points = env.unwrapped.model, np.random.default_rng(0).uniform(-14.0, 14.0, (2000, 1, 2))
    blocks = [g for g in range(model.ngeom) if model.geom(g).name.startswith("block")]

    def inside(centers, halves):
        return (np.abs(points - centers) < halves).all(axis=2).any(axis=1)

    kept_out = env.constraints[0].keep_out
    found = inside([box.center for box in kept_out], [box.half_size for box in kept_out])
    np.testing.assert_array_equal(found, inside(model.geom_pos[blocks, :2], model.geom_size[blocks, :2]))
    assert 0.1 < found.mean() < 0.9


def test_hulls_are_as_large_as_the_geoms():
    envs = [gym.make(f"Safe{robot}Goal2-v0") for robot in ("Point", "Car")]
    (point,), (car,) = (sw.protect(env).constraints for env in envs)
    sphere, nose = (envs[0].unwrapped.model.geom(name) for name in ("agent", "pointarrow"))
    own, (ahead, radius) = point.parts
    corners = [np.hypot(nose.pos[0] + side * nose.size[0] - ahead, nose.size[1]) for side in (-1.0, 1.0)]
    assert own == [0.0, sphere.size[0]] and max(corners) <= radius < max(corners) + 1e-3
    vase = envs[0].unwrapped.model.geom("vase0").size
    assert np.hypot(*vase[:2]) <= VASE_HULL_RADIUS_M < np.hypot(*vase[:2]) + 1e-3
    (hazards,), (vases,) = point.obstacles, point.untouched
    assert (hazards.radius, vases.radius) == (HAZARD_RADIUS, VASE_HULL_RADIUS_M)
    both_sides = {(side * x, y) for x, y in CAR.hull_corners for side in (1.0, -1.0)}
    assert set(map(tuple, car.outline)) == both_sides
    assert [discs.radius for discs in car.keep_out + car.untouched] == [HAZARD_RADIUS, VASE_HULL_RADIUS_M]


def test_options_reach_the_filter():
    narrow, wide = (sw.protect(gym.make("Reacher-v5"), margin=m) for m in (0.0, 0.5))
    assert wide.constraints[0].margin == pytest.approx(narrow.constraints[0].margin + 0.5)
    plant = sw.MujocoPlant()
    env = sw.protect(gym.make("Reacher-v5"), plant=plant, fallback="zero")
    assert env.plant is plant


@pytest.mark.parametrize("options", [{"fallbak": "zero"}, {"constraints": []}])
def test_unknown_options_are_refused_with_the_list(options):
    with pytest.raises(UnknownNameError, match=f"no option {next(iter(options))!r}.*fallback.*margin"):
        sw.protect(gym.make("Reacher-v5"), **options)


def refusal(env):
    with pytest.raises(ConfigurationError) as caught:
        sw.protect(env)
    return str(caught.value)


class Slider(gym.Env):
    """A point on a line. Observed: position and speed."""

    observation_space = gym.spaces.Box(-100.0, 100.0, (2,), np.float64)

    def __init__(self, discrete=False):
        self.action_space = gym.spaces.Discrete(3, start=-1) if discrete else gym.spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = np.zeros(2)
        return self.state, {}

    def step(self, action):
        self.state = self.state + 0.1 * np.array([self.state[1], float(np.atleast_1d(action)[0])])
        return self.state, 0.0, False, False, {}


UNKNOWN = {
    "JointSpeedLimit(limit=4.0)": lambda: gym.make("lab/Arm-v0"),
    "PredictiveShield(h, horizon, backup)": lambda: Slider(),
    "sw.ActionShield(": lambda: Slider(discrete=True),
}


@pytest.mark.parametrize("says", UNKNOWN)
def test_an_env_without_a_recipe_gets_lines_that_filter_it(says):
    with mock.patch.dict(gym.registry):
        gym.register("lab/Arm-v0", entry_point="gymnasium.envs.mujoco.reacher_v5:ReacherEnv")
        env = UNKNOWN[says]()
        message = refusal(env)
    assert says in message
    lines = textwrap.dedent("\n".join(line for line in message.splitlines() if line.startswith("    ")))
    discrete = isinstance(env.action_space, gym.spaces.Discrete)
    scope = {"env": env, "horizon": 2, "h": lambda seen: 0.25 - abs(seen[1])}
    scope["backup"] = lambda seen: -int(np.sign(seen[1])) if discrete else [-np.sign(seen[1])]
    exec(lines, scope)
    filtered = scope["env"]
    filtered.reset(seed=0)
    infos = [
        filtered.step(1 if discrete else np.ones(env.action_space.shape, np.float32))[4] for _ in range(8)
    ]
    assert any(info["cbf/intervened"] for info in infos) and not any(info["cbf/infeasible"] for info in infos)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "case",
    [pytest.param(c, marks=pytest.mark.slow) if "Kitchen" in c.env_id else c for c in shelf.CASES],
    ids=lambda case: case.env_id,
)
def test_an_attacker_breaks_no_limit_of_another_packages_env_in_silence(case):
    pytest.importorskip(case.needs or "gymnasium")
    steps = {"": 60, "shimmy": 60}.get(case.needs, 3)
    on, off = (shelf.run(case, "attacking", filtered, steps) for filtered in (True, False))
    assert on["unflagged"] == 0 and on["violations"] <= off["violations"]
    if case.needs in ("", "gymnasium_robotics") and "MountainCar" not in case.env_id:
        assert on["violations"] == on["infeasible"] == 0 < min(on["changed"], off["violations"])


def test_actions_that_no_lines_protect_are_refused_at_once_and_a_model_that_is_not_mujoco_s_is_simulated():
    env = Slider()
    env.model = "a network of its own"
    assert "PredictiveShield(h, horizon, backup)" in refusal(env)
    env.action_space = gym.spaces.MultiDiscrete([3, 3])
    message = refusal(env)
    assert "flatten_space" in message and "no recipe" not in message


def test_what_cannot_be_copied_is_simulated_by_forks():
    pytest.importorskip("Box2D")
    with pytest.raises(UnsupportedEnvError, match="cannot be copied"):
        sw.protect(gym.make("BipedalWalker-v3"), plant=sw.SimulatorPlant())


def test_other_vector_envs_are_told_how_to_protect_each_env():
    vector = gym.make_vec("Reacher-v5", num_envs=2, vectorization_mode="async")
    assert "vectorization_mode='sync', wrappers=[sw.protect])" in refusal(vector)
    vector.close()
    discrete = gym.make_vec("CartPole-v1", num_envs=2, vectorization_mode="sync")
    assert "discrete actions are shielded env by env" in refusal(discrete)


def test_a_synchronous_vector_env_gets_one_filter_for_all_and_takes_the_same_options():
    envs = sw.protect(
        gym.make_vec("SafePointGoal1-v0", 2, vectorization_mode="sync"), detour=False, margin=0.1
    )
    assert isinstance(envs, sw.VectorCBFActionFilter)
    one = sw.protect(gym.make("SafePointGoal1-v0"), detour=False, margin=0.1)
    assert [single.constraints for single in envs.filters] == [one.constraints] * 2
    ids = [lambda: gym.make("SafePointGoal1-v0"), lambda: gym.make("SafePointGoal2-v0")]
    mixed = gym.vector.SyncVectorEnv(ids, observation_mode="different")
    assert "expected a vector env of one id, got ['SafePointGoal1-v0', 'SafePointGoal2-v0']" in refusal(mixed)
