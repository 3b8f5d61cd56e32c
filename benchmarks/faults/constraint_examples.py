"""An example of every exported constraint and obstacle, each in a filter on a real env.

They are found by `safe_wrappers.constraints.__all__`; a new one needs an example, or a reason in `NO_CONSTRAINT`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

import safe_wrappers as sw
from benchmarks import tracked
from benchmarks.faults.wrapper_examples import Env
from safe_wrappers import constraints as of
from safe_wrappers.envs.safe_rover import WHEELS
from safe_wrappers.recipes import RECIPES


def _itself(env: Env) -> Env:
    return env


class Example(NamedTuple):
    """A constraint on an env: its id, the constraint for it, what is inside the filter, and options of the filter."""

    env_id: str
    constraint: Callable[[Env], Any]
    inside: Callable[[Env], Env] = _itself
    options: Callable[[], dict[str, Any]] = dict

    def make(self, around: Callable[[Env], Env] = _itself, **more: Any) -> sw.CBFActionFilter:
        """The filter, with more arguments; `around` is put around the task first."""
        if "Maze" in self.env_id:
            import gymnasium_robotics

            gym.register_envs(gymnasium_robotics)
        env = self.inside(around(gym.make(self.env_id)))
        return sw.CBFActionFilter(env, [self.constraint(env)], **(self.options() | more))


def _pendulum() -> dict[str, Any]:
    plant = sw.AnalyticPlant(
        f=lambda x: np.array([x[1], 15.0 * np.sin(x[0])]),
        g=lambda x: np.array([[0.0], [3.0]]),
        state=lambda env: env.state,
        control_dt=0.05,
    )
    return {"plant": plant}


def _tip(*obstacles: Any) -> of.Workspace:
    return of.Workspace(keep_out=list(obstacles), bodies=["fingertip"], margin=0.001, horizon=3)


def _slow(x: Any) -> float:
    return 6.0 - abs(float(x[2]))


def _against(x: Any) -> list[float]:
    return [float(np.clip(-4.0 * x[2], -2.0, 2.0))]


EXAMPLES: dict[str, Example] = {
    "Barrier": Example(
        "Pendulum-v1", lambda env: of.Barrier(lambda x: 4.0 - x[1] ** 2, alpha=2.0), options=_pendulum
    ),
    "Box": Example("Reacher-v5", lambda env: _tip(of.Box([0.12, 0.05, 0.0], [0.03, 0.03, 0.05]))),
    "Clearance": Example(
        "InvertedPendulum-v5",
        lambda env: of.Clearance([of.Plane([-0.9], [1]), of.Plane([0.9], [-1])], 8.0, bodies=["cart"]),
    ),
    "CoastingClearance": Example("SafeCarGoal1-v0", lambda env: RECIPES["SafeCarGoal1"](env)[0]),
    "ContactFeasibility": Example("HalfCheetah-v5", lambda env: of.ContactFeasibility(friction_share=0.7)),
    "Disc": Example("Reacher-v5", lambda env: _tip(of.Disc([0.12, 0.05], 0.03))),
    "Discs": Example(
        "SafePointGoal1-v0", lambda env: of.Clearance([of.Discs("hazard_positions", 0.2)], 1.0, bodies=["agent"])
    ),
    "EscapeClearance": Example(
        "OccludedCrossing-v0", lambda env: RECIPES["OccludedCrossing"](env)[0], inside=tracked.crossing
    ),
    "HeadingDriveClearance": Example("SafePointGoal1-v0", lambda env: RECIPES["SafePointGoal1"](env)[0]),
    "ImpactSpeedLimit": Example(
        "Pusher-v5",
        lambda env: of.ImpactSpeedLimit(
            ["tips_arm"], ["table"], force_limit=60.0, stiffness=25e3, margin=2.0, horizon=3
        ),
    ),
    "JointPositionLimit": Example(
        "Reacher-v5", lambda env: of.JointPositionLimit(-1.0, 1.0, ["joint1"], margin=0.01, horizon=5)
    ),
    "JointSpeedLimit": Example("Reacher-v5", lambda env: of.JointSpeedLimit(4.0)),
    "Plane": Example(
        "TeleopContact-v0",
        lambda env: of.Clearance([of.Plane([0.0, 0.25], [0.0, -1.0])], 24.0, bodies=["tool"], radius=0.015),
    ),
    "PredictiveShield": Example(
        "Pendulum-v1",
        lambda env: of.PredictiveShield(_slow, horizon=20, backup=_against),
        options=lambda: {"plant": sw.SimulatorPlant(check_steps=50)},
    ),
    "SingularityMargin": Example(
        "Reacher-v5",
        lambda env: of.SingularityMargin(
            body="fingertip", directions="xy", task_speed=0.1, rate_limit=5.0, horizon=3
        ),
    ),
    "SpeedLimit": Example(
        "HalfCheetah-v5", lambda env: of.SpeedLimit(0.6, body="torso", direction="+x", margin=0.02)
    ),
    "Sphere": Example("Reacher-v5", lambda env: _tip(of.Sphere([0.12, 0.05, 0.01], 0.03))),
    "Stance": Example("HalfCheetah-v5", lambda env: of.Stance(friction_share=0.7)),
    "SupportMargin": Example("Ant-v5", lambda env: of.SupportMargin(inset=0.1)),
    "TrackPermission": Example(
        "OccludedCrossing-v0",
        lambda env: of.TrackPermission("robot", braking=3.0, tracks=["car0"]),
        inside=tracked.crossing,
    ),
    "TrackedDiscs": Example(
        "OccludedCrossing-v0",
        lambda env: of.Clearance([of.TrackedDiscs(0.4)], 2.0, bodies=["robot"], radius=0.2, margin=0.1),
        inside=tracked.crossing,
    ),
    "Traction": Example("SafeRover-v0", lambda env: of.Traction(list(WHEELS), max_slip=0.15)),
    "Upright": Example("HalfCheetah-v5", lambda env: of.Upright("torso", tilt=0.7, margin=0.02)),
    "WallClearance": Example("PointMaze_UMaze-v3", lambda env: of.WallClearance(velocity_clip=5.0)),
    "Workspace": Example(
        "Reacher-v5",
        lambda env: of.Workspace(
            [-0.15, -0.1, None], [0.22, 0.12, None], bodies=["fingertip"], margin=0.003, horizon=3
        ),
    ),
}  # fmt: skip
"""Exported name -> the constraint, or one that has the obstacle."""

NO_CONSTRAINT = {
    "BoundBackupClearance": "a base class of bound constraints; its subclasses are in the matrix"
}
"""Exported name -> why it has no row."""
