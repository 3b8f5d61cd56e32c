"""The velocity tasks on Gymnasium's v5 envs."""

from gymnasium.envs.mujoco.ant_v5 import AntEnv
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv
from gymnasium.envs.mujoco.hopper_v5 import HopperEnv
from gymnasium.envs.mujoco.humanoid_v5 import HumanoidEnv
from gymnasium.envs.mujoco.swimmer_v5 import SwimmerEnv
from gymnasium.envs.mujoco.walker2d_v5 import Walker2dEnv

from . import SafePlanarVelocityEnv, SafeVelocityEnv
from .speed_limits import SPEED_LIMITS


class SafeHalfCheetahVelocityEnv(SafeVelocityEnv, HalfCheetahEnv):
    """HalfCheetah-v5 with the cost of speed."""

    speed_limit = SPEED_LIMITS["HalfCheetah"]


class SafeHopperVelocityEnv(SafeVelocityEnv, HopperEnv):
    """Hopper-v5 with the cost of speed."""

    speed_limit = SPEED_LIMITS["Hopper"]


class SafeWalker2dVelocityEnv(SafeVelocityEnv, Walker2dEnv):
    """Walker2d-v5 with the cost of speed."""

    speed_limit = SPEED_LIMITS["Walker2d"]


class SafeSwimmerVelocityEnv(SafeVelocityEnv, SwimmerEnv):
    """Swimmer-v5 with the cost of speed."""

    speed_limit = SPEED_LIMITS["Swimmer"]


class SafeAntVelocityEnv(SafePlanarVelocityEnv, AntEnv):
    """Ant-v5 with the cost of speed."""

    speed_limit = SPEED_LIMITS["Ant"]


class SafeHumanoidVelocityEnv(SafePlanarVelocityEnv, HumanoidEnv):
    """Humanoid-v5 with the cost of speed."""

    speed_limit = SPEED_LIMITS["Humanoid"]
