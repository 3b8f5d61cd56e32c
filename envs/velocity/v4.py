"""The velocity tasks on Gymnasium's v4 envs: the physics and rewards of the published numbers."""

from gymnasium.envs.mujoco.ant_v4 import AntEnv
from gymnasium.envs.mujoco.half_cheetah_v4 import HalfCheetahEnv
from gymnasium.envs.mujoco.hopper_v4 import HopperEnv
from gymnasium.envs.mujoco.humanoid_v4 import HumanoidEnv
from gymnasium.envs.mujoco.swimmer_v4 import SwimmerEnv
from gymnasium.envs.mujoco.walker2d_v4 import Walker2dEnv

from . import SafePlanarVelocityEnv, SafeVelocityEnv
from .speed_limits import SPEED_LIMITS


class SafeHalfCheetahVelocityEnv(SafeVelocityEnv, HalfCheetahEnv):
    """HalfCheetah-v4 with the cost of speed."""

    speed_limit = SPEED_LIMITS["HalfCheetah"]


class SafeHopperVelocityEnv(SafeVelocityEnv, HopperEnv):
    """Hopper-v4 with the cost of speed."""

    speed_limit = SPEED_LIMITS["Hopper"]


class SafeWalker2dVelocityEnv(SafeVelocityEnv, Walker2dEnv):
    """Walker2d-v4 with the cost of speed."""

    speed_limit = SPEED_LIMITS["Walker2d"]


class SafeSwimmerVelocityEnv(SafeVelocityEnv, SwimmerEnv):
    """Swimmer-v4 with the cost of speed."""

    speed_limit = SPEED_LIMITS["Swimmer"]


class SafeAntVelocityEnv(SafePlanarVelocityEnv, AntEnv):
    """Ant-v4 with the cost of speed."""

    speed_limit = SPEED_LIMITS["Ant"]


class SafeHumanoidVelocityEnv(SafePlanarVelocityEnv, HumanoidEnv):
    """Humanoid-v4 with the cost of speed."""

    speed_limit = SPEED_LIMITS["Humanoid"]
