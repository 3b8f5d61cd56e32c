"""An example of every exported wrapper, for tests/contract.

They are found by `safe_wrappers.__all__`; a new one needs an example below and is then held to all of it.
"""

import inspect
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv

import safe_wrappers as sw
from safe_wrappers.envs.safe_rover import WHEELS

Env = gym.Env[Any, Any]

TASK, CROSSING = "SafePointGoal1-v0", "OccludedCrossing-v0"
DISCRETE = "tests/ThreeTorques-v0"


class ThreeTorques(InvertedPendulumEnv):
    """A pole on a cart that is pushed left, right, or not at all; beyond 0.1 rad it costs."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.action_space = gym.spaces.Discrete(3)

    work = 0

    def step(self, action: Any) -> Any:
        assert self.action_space.contains(action)
        sum(range(self.work))
        observation, reward, terminated, truncated, info = super().step(np.array([int(action) - 1.0]))
        return observation, reward, terminated, truncated, info | {"cost": float(abs(observation[1]) > 0.1)}


gym.register(DISCRETE, entry_point=f"{__name__}:ThreeTorques", max_episode_steps=1000)


def clearance() -> sw.constraints.HeadingDriveClearance:
    """Out of the hazards."""
    return sw.constraints.HeadingDriveClearance(
        [sw.constraints.Discs("hazard_positions", radius=0.2)], margin=0.004
    )


def rail(**more: Any) -> sw.constraints.Clearance:
    """On the rail."""
    ends = [sw.constraints.Plane([-0.9], [1]), sw.constraints.Plane([0.9], [-1])]
    return sw.constraints.Clearance(ends, bodies=["cart"], braking=8.0, **more)


def _joint_speed(env: Any) -> float:
    return float(abs(env.data.qvel[0]))


EXAMPLES: dict[str, dict[str, tuple[str, Callable[[], dict[str, Any]]]]] = {
    "ActionRepeat": {"four control steps": (TASK, lambda: {"repeat": 4})},
    "ActionShield": {
        "the cost of the env": (
            DISCRETE,
            lambda: {
                "constraints": [sw.constraints.PredictiveShield("cost", 6, backup=[0, 1, 2])],
                "fallback": "hold",
            },
        )
    },
    "AdaptionPenalty": {"a constant": (TASK, lambda: {"penalty": 0.5})},
    "BalanceMonitor": {
        "everything": ("HalfCheetah-v5", dict),
        "a trunk and its legs": ("Ant-v5", lambda: {"bodies": ["torso"]}),
    },
    "CBFActionFilter": {
        "a HeadingDriveClearance": (TASK, lambda: {"constraints": [clearance()]}),
        "a JointSpeedLimit with options": (
            "Reacher-v5",
            lambda: {"constraints": [sw.constraints.JointSpeedLimit(4.0)], "fallback": "hold", "margin": 0.1},
        ),
        "a Clearance": ("InvertedPendulum-v5", lambda: {"constraints": [rail()]}),
    },
    "ChunkHandover": {
        "a delay drawn for every chunk": (
            "Reacher-v5",
            lambda: {
                "chunk_size": 8,
                "execution_horizon": 3,
                "inference_delay": [0, 2],
                "rate_limit": [20.0, 30.0],
            },
        ),
        "limits of the machine": (
            "Reacher-v5",
            lambda: {
                "chunk_size": 8,
                "execution_horizon": 3,
                "limits": sw.SeamLimits(velocity=20.0, acceleration=[800.0, 900.0], arrival="moving"),
                "fallback": "hold",
            },
        ),
        "chunks of one": (
            TASK,
            lambda: {"chunk_size": 1, "execution_horizon": 1, "blend_time": 0.5, "fallback": "hold"},
        ),
    },
    "ContactMonitor": {
        "everything": (TASK, dict),
        "feet on the floor": ("HalfCheetah-v5", lambda: {"bodies": ["bfoot", "ffoot"], "against": ["world"]}),
    },
    "CostFunction": {"a function by its name": ("Reacher-v5", lambda: {"fn": f"{__name__}:_joint_speed"})},
    "FilterObservation": {
        "constraints without a filter": (
            "Reacher-v5",
            lambda: {"constraints": [sw.constraints.JointSpeedLimit(4.0)], "neighbours": 2},
        ),
        "discs": (TASK, lambda: {"constraints": [clearance()]}),
    },
    "LeaseExpiry": {
        "a Clearance": (
            "InvertedPendulum-v5",
            lambda: {"budget": sw.StoppingBudget(rail(), acceleration=20.0, top_speed=5.0, delays_s=0.01)},
        ),
        "a value with a closing speed": (
            TASK,
            lambda: {"budget": {"clearance": clearance(), "closing_speed": 4.0}, "blend_time": 0.0},
        ),
    },
    "OcclusionPenalty": {
        "cars and published points on the crossing": (
            CROSSING,
            lambda: {
                "tracks": [
                    sw.occlusion.Track("car*", acceleration_noise=[0.0225, 0.0], reversion_s=2.0),
                    sw.occlusion.Track(published="pillar_positions", acceleration_noise=0),
                ],
                "sensor": sw.occlusion.Sensor("eye", view_deg=120.0, range_m=6.0),
                "tolerance": 0.5,
                "weight": 0.1,
            },
        ),
        "bodies in space, and nothing added to the observation": (
            "HalfCheetah-v5",
            lambda: {
                "tracks": [sw.occlusion.Track("?foot", acceleration_noise=100.0)],
                "sensor": {"camera": "track", "position_std": 0.1, "velocity_std": 0.1},
                "tolerance": 0.1,
                "sigmas": 2.0,
                "axes": "xyz",
                "observe": False,
            },
        ),
    },
    "RecordInterventions": {"no arguments": (TASK, dict)},
    "SafetyOverlay": {"of a filter": (TASK, dict)},
    "SlipLimiter": {
        "all wheels": ("SafeRover-v0", lambda: {"wheels": list(WHEELS)}),
        "the rear ones, with options": (
            "SafeRover-v0",
            lambda: {"wheels": ["rear_left", "rear_right"], "max_slip": 0.1, "friction": 0.05},
        ),
    },
    "StuckMonitor": {"sooner": (TASK, lambda: {"after_s": 0.5, "progress": 0.1})},
    "TeleopChannel": {
        "plain, any env": (
            "Reacher-v5",
            lambda: {
                "uplink": sw.teleop.Link(0.04, 0.03, loss=0.1),
                "downlink": {"delay_s": 0.02, "loss": 0.2},
            },
        ),
        "waves under a ceiling": (
            "TeleopContact-v0",
            lambda: {
                "uplink": sw.teleop.Link(0.003, 0.004, loss=0.05),
                "downlink": 0.002,
                "impedance": 40.0,
                "budget": sw.StoppingBudget(
                    sw.constraints.Clearance(
                        [sw.constraints.Plane([0, 0.25], [0, -1])], 24.0, bodies=["tool"], radius=0.015
                    ),
                    acceleration=55.0,
                    top_speed=1.4,
                ),
            },
        ),
    },
    "WholeBodyFilter": {
        "forecasts": (
            "Hopper-v5",
            lambda: {"friction_share": 0.6, "joint_tolerance": 0.2, "zmp_inset": 0.01, "tolerance": 0.02},
        ),
        "contacts alone": ("HalfCheetah-v5", lambda: {"friction_share": 0.5, "joint_tolerance": None}),
    },
}
"""Wrapper name -> what it shows -> (env id, function of its arguments): plain data or what becomes it."""

INSIDE: dict[str, Callable[[Env], Env]] = dict.fromkeys(
    ("AdaptionPenalty", "SafetyOverlay", "StuckMonitor"), lambda env: sw.CBFActionFilter(env, [clearance()])
)
"""Wrapper name -> the wrapper that it needs inside."""

MADE_WITH: dict[str, dict[str, Any]] = {"SafetyOverlay": {"render_mode": "rgb_array"}}
"""Wrapper name -> arguments of `gym.make` that it needs."""

CHUNKED = ("ChunkHandover",)
"""Wrappers whose action is a chunk, shape (chunk_size, controls), executed over several control steps."""

FILTERS = ("CBFActionFilter", "SlipLimiter", "WholeBodyFilter")
"""Wrappers that let no action through that is not finite or outside the action space."""

ONLY_LOOKING = (
    "ActionRepeat",
    "BalanceMonitor",
    "ContactMonitor",
    "CostFunction",
    "FilterObservation",
    "OcclusionPenalty",
    "RecordInterventions",
)
"""Wrappers that look on and pass every finite action as it is."""
SILENT = ("ActionRepeat", "FilterObservation", "SafetyOverlay")
"""They add nothing to info."""

EXPORTED = sorted(
    name
    for name in sw.__all__
    if inspect.isclass(getattr(sw, name)) and issubclass(getattr(sw, name), gym.Wrapper)
)
CASES = [(name, case) for name in EXPORTED for case in EXAMPLES.get(name, {"": None})]


def example(name: str, case: str) -> tuple[str, Callable[[], dict[str, Any]]]:
    """The env's id and the function of the arguments."""
    assert name in EXAMPLES, f"{name} is exported but has no example: add one to EXAMPLES in {__file__}"
    return EXAMPLES[name][case]


def made(name: str, env_id: str) -> Env:
    """The task as the wrapper needs it."""
    return gym.make(env_id, **MADE_WITH.get(name, {}))


def inside(name: str, env: Env) -> Env:
    """The env as the wrapper needs it."""
    return INSIDE.get(name, lambda env: env)(env)


def build(name: str, case: str, around: Callable[[Env], Env] = lambda env: env, **more: Any) -> Any:
    """The wrapper of an example, with more arguments; `around` is put around the task first."""
    env_id, arguments = example(name, case)
    return getattr(sw, name)(inside(name, around(made(name, env_id))), **(arguments() | more))
