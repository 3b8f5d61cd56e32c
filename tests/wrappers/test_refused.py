"""What the constructors refuse: numbers, names, envs and wrappers inside, each with words that name the remedy."""

import math

import gymnasium as gym
import numpy as np
import pytest
from braked_cart import BrakedCart, cart_plant
from worlds import Raw
from wrapper_examples import EXAMPLES, example, inside, made

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError, UnknownNameError, UnsupportedEnvError
from safe_wrappers.wrappers.faults import FAULTS, Outages, RepeatedCommands

SPEED = sw.constraints.JointSpeedLimit(2.0)
RAIL = sw.constraints.Clearance([sw.constraints.Plane([-0.9], [1])], bodies=["cart"], braking=8.0)
SPOTS = sw.occlusion.Track(published="pillar_positions", acceleration_noise=1)


def bad(name, words, error=ConfigurationError, on=None, **arguments):
    """A wrapper with its example's arguments, but for these, around its example's env or another one."""
    return pytest.param(name, words, error, on, arguments, id=f"{name}, {words}")


def cars(**arguments):
    return [sw.occlusion.Track(**{"bodies": "car*", "acceleration_noise": 0.1} | arguments)]


def reacher(wrap):
    return lambda: wrap(gym.make("Reacher-v5"))


def acting(space):
    """An env with another action space."""

    def build():
        env = gym.make("Reacher-v5").unwrapped
        env.action_space = space
        return env

    return build


def pictured(mode, renderer=True):
    """An env with another render mode, which is MuJoCo's or not."""

    def build():
        env = gym.make("SafePointGoal1-v0", render_mode="rgb_array")
        env.unwrapped.render_mode = mode
        if not renderer:
            env.unwrapped.mujoco_renderer = None
        return env

    return build


def tracked():
    """A crossing whose observation has tracks of its own."""
    env = gym.make("OccludedCrossing-v0").unwrapped
    env.observation_space = gym.spaces.Dict({"tracks": gym.spaces.Box(0.0, 1.0, (2,))})
    return env


def bare(env_id):
    return lambda: gym.make(env_id)


def rescaled(env_id):
    return lambda: gym.wrappers.RescaleAction(gym.make(env_id), -1.0, 1.0)


def fixed(env):
    return 1.0, 0.0


CHANGES = r"inside the filter changes the actions .* put it outside"
NO_VECTOR = "expected a continuous Box action space of shape"
NO_CONTACTS = "no body of this model can touch"
ORDER = "d <= s <= H - d must hold"
REFUSED = [
    bad("ActionRepeat", "repeat .* got 0", repeat=0),
    bad("ActionShield", "a discrete action has no zero", fallback="zero"),
    bad("ActionShield", "use CBFActionFilter for a Box", on=bare("Reacher-v5")),
    bad("ActionShield", "1,024; got Discrete", on=acting(gym.spaces.Discrete(1025))),
    bad("AdaptionPenalty", "needs a CBFActionFilter inside", on=bare("Reacher-v5")),
    bad("AdaptionPenalty", "penalty must be a finite number > 0", penalty=0.0),
    bad("BalanceMonitor", "bodies is a list of names of bodies, or None", bodies="torso"),
    bad("BalanceMonitor", "no body 'tail'; give another", UnknownNameError, bodies=["torso", "tail"]),
    bad("BalanceMonitor", "of this model can touch", UnsupportedEnvError, on=bare("Reacher-v5")),
    bad("CBFActionFilter", "constraints is a list with at least one, got", constraints=[]),
    bad("CBFActionFilter", "expected a constraint .* got 3", constraints=[3]),
    bad("CBFActionFilter", "unknown kind 'Wall'", UnknownNameError, constraints=[{"kind": "Wall"}]),
    bad("CBFActionFilter", "margin", margin=-0.1),
    bad("CBFActionFilter", CHANGES, on=reacher(lambda env: gym.wrappers.StickyAction(env, 0.5))),
    bad("CBFActionFilter", CHANGES, on=reacher(lambda env: gym.wrappers.MaxAndSkipObservation(env, skip=4))),
    bad("CBFActionFilter", CHANGES, on=reacher(lambda env: gym.wrappers.RescaleAction(env, -2.0, 2.0))),
    bad("CBFActionFilter", NO_VECTOR, on=acting(gym.spaces.Dict(a=gym.spaces.Box(-1.0, 1.0, (2,))))),
    bad("CBFActionFilter", NO_VECTOR, on=acting(gym.spaces.Discrete(3))),
    bad("CBFActionFilter", NO_VECTOR, on=acting(gym.spaces.Box(-1.0, 1.0, (1, 2)))),
    bad("CBFActionFilter", NO_VECTOR, on=acting(gym.spaces.Box(-1, 1, (2,), np.int64))),
    bad("ChunkHandover", f"{ORDER}.*H = 8 control steps", execution_horizon=9),
    bad("ChunkHandover", ORDER, inference_delay=5),
    bad("ChunkHandover", ORDER, inference_delay=[0, 5], execution_horizon=8),
    bad("ChunkHandover", "inference_delay .* at least 0; got -1", inference_delay=-1),
    bad("ChunkHandover", "at least 0; got -1", inference_delay=[-1, 2]),
    bad("ChunkHandover", r"\[least, most\]", inference_delay=[2, 1]),
    bad("ChunkHandover", "chunk_size .* at least 1; got True", chunk_size=True),
    bad("ChunkHandover", "execution_horizon .* at least 1; got 0", execution_horizon=0),
    bad("ChunkHandover", "rate_limit .*> 0", rate_limit=0.0),
    bad("ChunkHandover", "rate_limit .*finite", rate_limit=math.nan),
    bad("ChunkHandover", "one for each of the 2 action components", rate_limit=[5.0, 5.0, 5.0]),
    bad("ChunkHandover", "blend_time .*> 0", blend_time=0.0),
    bad("ChunkHandover", "a blend of 8 .* choose a longer chunk_size", blend_time=0.18, inference_delay=0),
    bad("ChunkHandover", "6 control steps", blend_time=0.14),
    bad("ChunkHandover", "Give rate_limit, blend_time or limits", rate_limit=None),
    bad("ChunkHandover", "Give rate_limit, blend_time or limits", rate_limit=None, limits={}),
    bad("ChunkHandover", "no fallback 'sleep'; choose brake, hold, zero", UnknownNameError, fallback="sleep"),
    bad("ChunkHandover", "(?i)mujoco", UnsupportedEnvError, on=BrakedCart, rate_limit=1.0),
    bad("ChunkHandover", '"brake" needs a MujocoPlant', on=BrakedCart, rate_limit=1.0, plant=cart_plant(0.1)),
    bad("ChunkHandover", "plant is a MujocoPlant", plant=3),
    bad("ChunkHandover", "limits.velocity must be a finite number > 0", limits={"velocity": 0.0}),
    bad("ChunkHandover", "limits.jerk", limits={"jerk": [1.0, -2.0]}),
    bad("ChunkHandover", "limits.velocity is one number, or one for each", limits={"velocity": [1.0] * 3}),
    bad("ChunkHandover", "limits has no 'speed'; it has velocity", UnknownNameError, limits={"speed": 1.0}),
    bad("ChunkHandover", "limits is a SeamLimits", limits=3.0),
    bad("ChunkHandover", "no position servo", UnsupportedEnvError, limits={"torque": 3.0}),
    bad("ChunkHandover", '"moving" or "rest"', limits={"arrival": "soon", "acceleration": 2.0}),
    bad("ChunkHandover", "beside an acceleration", limits={"arrival": "rest", "velocity": 1.0}),
    bad("ChunkHandover", "steps_per_entry", steps_per_entry=0),
    bad("ChunkHandover", "at least 2", chunk_size=1, execution_horizon=1, inference_delay=0, steps_per_entry=2),
    bad("ChunkHandover", "H = 29 control steps", execution_horizon=30, steps_per_entry=4),
    bad("ContactMonitor", "no body 'tail'", UnknownNameError, bodies=["tail"]),
    bad("ContactMonitor", r"MuJoCo's \.model", UnsupportedEnvError, on=bare("Pendulum-v1")),
    bad("CostFunction", "or its name 'module:function'; got 3", fn=3),
    bad("CostFunction", "or its name 'module:function'; got 'math'", fn="math"),
    bad("CostFunction", "got 'math:pi'", fn="math:pi"),
    bad("CostFunction", "cannot be imported: No module named 'no_such_module'", fn="no_such_module:cost"),
    bad("CostFunction", "cannot be imported: module 'math' has no attribute", fn="math:no_such"),
    bad("CostFunction", "cannot be imported", fn="a b:c"),
    bad("FilterObservation", "without one give it constraints", constraints=None),
    bad("FilterObservation", "shows what the filter inside", on=reacher(lambda e: sw.CBFActionFilter(e, [SPEED]))),
    bad("FilterObservation", "without one give it", on=reacher(sw.protect), constraints=None, plant=sw.MujocoPlant()),
    bad("FilterObservation", "neighbours", neighbours=-1),
    bad("LeaseExpiry", "min_lease_s.*CBFActionFilter", min_lease_s=0.1),
    bad("LeaseExpiry", "min_lease_s", min_lease_s=-0.1),
    bad("LeaseExpiry", "than min_lease_s = 2", min_lease_s=2.0),
    bad("LeaseExpiry", CHANGES, on=rescaled("InvertedPendulum-v5")),
    bad("LeaseExpiry", "Raw has no value", budget={"clearance": Raw([[1.0]], [1.0]), "closing_speed": 1.0}),
    bad("OcclusionPenalty", "tolerance.*> 0 in m, got 0", tolerance=0.0),
    bad("OcclusionPenalty", "weight", weight=-0.1),
    bad("OcclusionPenalty", "sigmas", sigmas=0.0),
    bad("OcclusionPenalty", "'xy' or 'xyz', got 'xz'", axes="xz"),
    bad("OcclusionPenalty", "at least one Track", tracks=[]),
    bad("OcclusionPenalty", "at least one Track", tracks="car*"),
    bad("OcclusionPenalty", "a track is a Track", tracks=["car*"]),
    bad("OcclusionPenalty", "'cat'; it has: .*car0", UnknownNameError, tracks=cars(bodies="cat")),
    bad("OcclusionPenalty", "no body ''", UnknownNameError, tracks=cars(bodies="")),
    bad("OcclusionPenalty", "'pillars'.*pillar_positions", UnknownNameError,
        tracks=cars(bodies=None, published="pillars")),
    bad("OcclusionPenalty", r"shape \(k, 2\)", tracks=cars(bodies=None, published="dt")),
    bad("OcclusionPenalty", "one per coordinate", tracks=cars(acceleration_noise=[[1, 2], [2, 1]])),
    bad("OcclusionPenalty", "start_position_std", tracks=cars(start_position_std=-1)),
    bad("OcclusionPenalty", "no camera 'nose'; it has: .*eye", UnknownNameError, sensor="nose"),
    bad("OcclusionPenalty", "no site 'nose'; it has", UnknownNameError, sensor={"site": "nose"}),
    bad("OcclusionPenalty", "velocities are measured of bodies", tracks=[SPOTS],
        sensor={"camera": "eye", "velocity_std": 0.1}),
    bad("OcclusionPenalty", r"MuJoCo's \.model", UnsupportedEnvError, on=bare("Pendulum-v1")),
    bad("OcclusionPenalty", "'tracks' already", on=tracked, observe=True),
    bad("SafetyOverlay", r"is None: .*gym.make\(\.\.\., render_mode='rgb_array'", on=pictured(None)),
    bad("SafetyOverlay", "'depth_array'", on=pictured("depth_array")),
    bad("SafetyOverlay", r"is 'human': .*render_mode='rgb_array'\)", on=pictured("human", renderer=False)),
    bad("StuckMonitor", "needs a CBFActionFilter inside", on=bare("Reacher-v5")),
    bad("StuckMonitor", "after_s", after_s=0.0),
    bad("StuckMonitor", "progress", progress=math.nan),
    bad("TeleopChannel", "delay_s", uplink=-0.1),
    bad("TeleopChannel", "loss", downlink={"loss": 2.0}),
    bad("TeleopChannel", "impedance", on=bare("TeleopContact-v0"), impedance=0.0),
    bad("TeleopChannel", "need a port", impedance=10.0),
    bad("TeleopChannel", CHANGES, on=rescaled("TeleopContact-v0"), impedance=10.0),
    bad("TeleopChannel", CHANGES, on=rescaled("Pendulum-v1"), budget=sw.StoppingBudget(fixed, 1.0, 1.0)),
    bad("TeleopChannel", "human_s", human_s=-0.1),
    bad("TeleopChannel", "video_s", video_s=-0.1),
    bad("TeleopChannel", "longest_s", longest_s=0.0),
    bad("TeleopChannel", "StoppingBudget", budget=0.2),
    bad("TeleopChannel", "how fast it is approached", budget={"clearance": SPEED, "closing_speed": 1.0}),
    bad("TeleopChannel", "Box action space", on=bare("CartPole-v1")),
    bad("TeleopChannel", "MuJoCo", UnsupportedEnvError, on=bare("Pendulum-v1"),
        budget={"clearance": RAIL, "acceleration": 1.0}),
    bad("WholeBodyFilter", "friction_share", friction_share=1.1),
    bad("WholeBodyFilter", "joint_tolerance", joint_tolerance=-0.1),
    bad("WholeBodyFilter", "inset", zmp_inset=0.0),
    bad("WholeBodyFilter", NO_CONTACTS, UnsupportedEnvError, on=bare("InvertedPendulum-v5")),
    bad("WholeBodyFilter", "MuJoCo", UnsupportedEnvError, on=bare("Pendulum-v1")),
    bad("WholeBodyFilter", "joint_tolerance=None", UnsupportedEnvError, on=bare("SafePointGoal1-v0")),
]  # fmt: skip


@pytest.mark.parametrize(("name", "words", "error", "on", "arguments"), REFUSED)
def test_a_wrapper_refuses_what_it_cannot_work_with(name, words, error, on, arguments):
    env_id, usual = example(name, next(iter(EXAMPLES[name])))
    env = inside(name, made(name, env_id)) if on is None else on()
    with pytest.raises(error, match=words) as raised:
        getattr(sw, name)(env, **usual() | arguments)
    assert type(raised.value) is error


@pytest.mark.parametrize(
    ("setting", "arguments", "words"),
    [
        (sw.StoppingBudget, {"clearance": fixed, "acceleration": 1.0}, "acceleration and braking"),
        (sw.StoppingBudget, {"clearance": fixed, "braking": 1.0}, "acceleration and braking"),
        (sw.StoppingBudget, {"clearance": RAIL, "acceleration": -1.0}, "acceleration must be .* >= 0"),
        (sw.StoppingBudget, {"clearance": RAIL, "acceleration": 1.0, "delays_s": -0.1}, "delays_s"),
        (sw.StoppingBudget, {"clearance": RAIL, "acceleration": 1.0, "top_speed": 0.0}, "top_speed"),
        (sw.StoppingBudget, {"clearance": RAIL}, "takes acceleration, and maybe top_speed"),
        (sw.StoppingBudget, {"clearance": RAIL, "acceleration": 1.0, "braking": 9.0}, "takes acceleration, and"),
        (sw.StoppingBudget, {"clearance": SPEED, "acceleration": 1.0}, "takes closing_speed; got"),
        (sw.StoppingBudget, {"clearance": SPEED, "closing_speed": 1.0, "top_speed": 1.0}, "takes closing_speed;"),
        (sw.occlusion.Imu, {"site": "eye", "accelerometer_std": -1.0}, "accelerometer_std"),
        (sw.occlusion.Imu, {"site": "eye", "fix_every_s": 0.0}, "fix_every_s"),
        (sw.occlusion.Sensor, {}, "at a camera or at a site: name one"),
        (sw.occlusion.Sensor, {"camera": "eye", "site": "eye"}, "at a camera or at a site: name one"),
        (sw.occlusion.Sensor, {"camera": "eye", "position_std": None}, "measures nothing: give position_std"),
        (sw.occlusion.Sensor, {"camera": "eye", "range_m": 0.0}, "range_m"),
        (sw.occlusion.Track, {"acceleration_noise": 0.1}, "follows bodies by name or pattern, or published"),
        (sw.occlusion.Track, {"bodies": "a", "acceleration_noise": 0.1, "reversion_s": 0.0}, "reversion_s"),
        (sw.teleop.Link, {"delay_s": -0.1}, "delay_s"),
        (sw.teleop.Link, {"jitter_s": -1.0}, "jitter_s"),
        (sw.teleop.Link, {"loss": -0.1}, "loss"),
        (RepeatedCommands, {"env": BrakedCart(), "share": 1.1}, "share"),
        (Outages, {"env": BrakedCart(), "mean_between_s": 0.0, "mean_length_s": 1.0}, "mean_between_s"),
        (Outages, {"env": BrakedCart(), "mean_between_s": 1.0, "mean_length_s": -1.0}, "mean_length_s"),
    ],
)  # fmt: skip
def test_settings_and_faults_refuse_what_makes_no_sense(setting, arguments, words):
    with pytest.raises(ConfigurationError, match=words):
        setting(**arguments)


# What a single constructor does not see, and remedies that work ---------------------------------------------------


def test_one_plant_for_two_envs():
    plant = sw.MujocoPlant()
    sw.CBFActionFilter(gym.make("Reacher-v5"), [SPEED], plant=plant)
    with pytest.raises(ConfigurationError, match="bound to another env already; give every filter a plant"):
        sw.CBFActionFilter(gym.make("Reacher-v5"), [SPEED], plant=plant)


@pytest.mark.parametrize("kind", FAULTS)
def test_an_env_that_does_not_say_how_long_a_step_lasts_is_told_what_to_give(kind):
    env = gym.make("MountainCarContinuous-v0")
    arguments = {"Outages": (1.0, 0.8), "RepeatedCommands": (0.4,)}[kind]
    with pytest.raises(ConfigurationError, match=r"give the env one, such as env\.unwrapped\.dt = 0\.05"):
        FAULTS[kind](env, *arguments)
    env.unwrapped.dt = 0.05
    assert FAULTS[kind](env, *arguments).control_dt == 0.05
