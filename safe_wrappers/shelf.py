"""Recipes for other packages' envs: what their own simulation is to keep, with backups that were measured."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from safe_wrappers.constraints.clearance import Clearance
from safe_wrappers.constraints.limits.points import SpeedLimit
from safe_wrappers.constraints.obstacles import Plane
from safe_wrappers.constraints.predictive_shield import PredictiveShield
from safe_wrappers.filter.constraint import Constraint
from safe_wrappers.plants.mujoco.plant import MujocoPlant
from safe_wrappers.plants.plant import Plant
from safe_wrappers.plants.rollouts import View
from safe_wrappers.plants.simulator.plant import SimulatorPlant

Env = gym.Env[Any, Any]
BOX2D_DT = 1.0 / 50.0
CARTPOLE_DT = 0.02
PANDA_DT = 0.04
"""Of panda-gym: 20 substeps of 2 ms."""
KITCHEN_SPEED = 1.0
"""Of FrankaKitchen's arm joints, rad/s."""
KITCHEN_DT = 0.08
"""Of FrankaKitchen: 40 substeps of 2 ms."""


def _pendulum(env: Env) -> list[Constraint]:
    # Its motor is weaker than gravity, but takes out energy: falling from the top it reaches 4.8 rad/s.
    def backup(x: Any) -> Any:
        return [np.clip(-4.0 * x[2], -2.0, 2.0)]

    return [PredictiveShield(lambda x: 6.0 - abs(x[2]), horizon=40, backup=backup)]


def _mountain_car(env: Env) -> list[Constraint]:
    power = env.unwrapped.power  # type: ignore[attr-defined]

    def backup(x: Any) -> Any:
        return [np.clip(-x[1] / power, -1.0, 1.0)]

    return [PredictiveShield(lambda x: 0.045 - abs(x[1]), horizon=60, backup=backup)]


def _cart_pole(env: Env) -> list[Constraint]:
    def h(x: Any) -> float:
        return float(min(1.0 - abs(x[2]) / 0.15, 1.0 - abs(x[0]) / 2.0))

    # The gains are those of the linear quadratic regulator for weights (1, 0.1, 10, 0.1) and 0.01.
    return [
        PredictiveShield(
            h, horizon=60, backup=lambda x: int(0.12 * x[0] + 0.15 * x[1] + x[2] + 0.24 * x[3] > 0.0)
        )
    ]


def _lunar_lander(env: Env) -> list[Constraint]:
    from gymnasium.envs.box2d import lunar_lander

    def h(view: View) -> float:
        if view.env.game_over:
            return -1.0
        return float(min(0.6 - abs(view.observation[4]), 1.0 - abs(view.observation[0])))

    def backup(view: View) -> Any:
        return lunar_lander.heuristic(view.env, view.observation)  # type: ignore[no-untyped-call]

    return [PredictiveShield(h, horizon=150, backup=backup, sees="view", candidates=6)]


CROUCH = (
    ((0.76, 0.49, -0.82, 0.82), 4.68, 0.31),
    ((0.66, 0.48, 0.30, 1.08), 5.80, 0.65),
    ((0.42, 1.05, -0.35, 0.53), 5.34, 1.00),
)
"""Angles of hips and knees, gains of position and speed, of a walker that stands: the best of 150 at random."""


def _bipedal_walker(env: Env) -> list[Constraint]:
    def crouch(target: tuple[float, ...], stiffness: float, damping: float) -> Callable[[View], Any]:
        def act(view: View) -> Any:
            angles, speeds = view.observation[[4, 6, 9, 11]], view.observation[[5, 7, 10, 12]]
            return np.clip(stiffness * (np.array(target) - angles) - damping * speeds, -1.0, 1.0)

        return act

    def h(view: View) -> float:
        return -1.0 if view.env.game_over else float(0.8 - abs(view.observation[0]))

    backups = [crouch(*posture) for posture in CROUCH]
    return [PredictiveShield(h, horizon=60, backup=backups, sees="view", candidates=6)]


def _panda(env: Env) -> list[Constraint]:
    low, high = np.array([-0.2, -0.2, 0.02]), np.array([0.2, 0.2, 0.3])

    def h(raw: Any) -> float:
        at = np.asarray(raw.robot.get_ee_position())
        return float(min((at - low).min(), (high - at).min()))

    return [PredictiveShield(h, horizon=4, backup="zero", sees="env", margin=0.002)]


def _highway(env: Env) -> list[Constraint]:
    # SLOWER, the last of its actions; or, with continuous ones, full braking straight on.
    backup = 4 if isinstance(env.action_space, gym.spaces.Discrete) else np.array([-1.0, 0.0])
    return [PredictiveShield("crashed", horizon=4, backup=[backup, "hold"], candidates=4)]


def _kitchen(env: Env) -> list[Constraint]:
    # Its targets are clipped ahead of noisy measurements: no MujocoPlant forecasts that, a copy with the noise does.
    def h(raw: Any) -> float:
        return float(KITCHEN_SPEED - np.abs(raw.data.qvel[:7]).max())

    return [PredictiveShield(h, horizon=3, backup="zero", sees="env", margin=0.05)]


def _dm_cartpole(env: Env) -> list[Constraint]:
    rail = [Plane([side], [-side]) for side in (-1.0, 1.0)]
    # 10 N on 1.1 kg of cart and pole is 9 m/s^2; the swinging pole takes up to a third of it.
    return [Clearance(obstacles=rail, bodies=["cart"], braking=6.0, margin=0.01)]


def _dm_walker(env: Env) -> list[Constraint]:
    # What dm_control reports is the velocity at the end of a step. Over a physics substep the centre of mass moves by
    # up to 0.18 m/s less (measured), since legs that turn at 50 rad/s bend its way.
    return [SpeedLimit(1.0, None, "+x", margin=0.3, horizon=10, average="substep")]


def _of_physics(env: Env) -> Plant:
    """The model and the data of dm_control's physics, in an env of shimmy's."""
    return MujocoPlant(
        model=lambda raw: raw._env.physics.model.ptr, data=lambda raw: raw._env.physics.data.ptr
    )


SHELF: dict[str, Callable[..., list[Constraint]]] = {
    "Pendulum": _pendulum,
    "MountainCarContinuous": _mountain_car,
    "CartPole": _cart_pole,
    "LunarLander": _lunar_lander,
    "LunarLanderContinuous": _lunar_lander,
    "BipedalWalker": _bipedal_walker,
    "BipedalWalkerHardcore": _bipedal_walker,
    "PandaReach": _panda,
    "highway": _highway,
    "highway-fast": _highway,
    "FrankaKitchen": _kitchen,
    "dm_control/cartpole": _dm_cartpole,
    "dm_control/walker": _dm_walker,
}
"""By the env's id without its version, as in `recipes.RECIPES`; dm_control's by the domain, without the task."""

PLANTS: dict[str, Callable[[Env], Plant]] = {
    "CartPole": lambda env: SimulatorPlant(control_dt=CARTPOLE_DT),
    **dict.fromkeys(
        ("LunarLander", "LunarLanderContinuous", "BipedalWalker", "BipedalWalkerHardcore"),
        lambda env: SimulatorPlant("fork", control_dt=BOX2D_DT),
    ),
    "PandaReach": lambda env: SimulatorPlant("fork", control_dt=PANDA_DT),
    "FrankaKitchen": lambda env: SimulatorPlant(control_dt=KITCHEN_DT),
    **dict.fromkeys(("dm_control/cartpole", "dm_control/walker"), _of_physics),
}
"""Likewise, where it is not the default one: Box2D's worlds and PyBullet's server cannot be copied."""
