"""The goal task with the point robot: ``SafePointGoal0-v0``, ``SafePointGoal1-v0``, ``SafePointGoal2-v0``."""

from typing import Any

from gymnasium.utils import EzPickle

from .goal.robot import POINT
from .goal_env import SafeGoalEnv


class SafePointGoalEnv(SafeGoalEnv):
    """`SafeGoalEnv` with a force along the heading and a turning-speed servo as its two controls.

    **Action**: ``Box(-1, 1, (2,))``. Control 0 pushes along the heading, clipped at 0.05, times the gear 0.3:
    at most 0.015 N on 5.19 g, reached at a control of 0.05 already. Control 1 asks for a turning speed of
    control / 0.3 rad/s, by a torque of at most 0.015 N m. That servo is unstable at the time step of 2 ms:
    the turning speed chatters by up to half a rad/s between substeps, and its mean is lower than asked for.
    Nothing acts sideways: the robot slides, with linear damping (0.01 N s/m, so speed decays with a time
    constant of 0.52 s).

    **Observation**: accelerometer 3 (m/s^2), velocimeter 3 (m/s), gyro 3 (rad/s), magnetometer 3, then the
    lidars of `SafeGoalEnv`. 28 numbers at level 0, 60 at levels 1 and 2.

    Args:
        level: 0, 1 or 2; see `SafeGoalEnv`.
        kwargs: Passed to `SafeGoalEnv` (``render_mode``, ``width``, ``height``, ``camera_name``, ...).
    """

    def __init__(self, level: int = 1, **kwargs: Any) -> None:
        # EzPickle rebuilds the class from these arguments, so it must see this class's signature.
        EzPickle.__init__(self, level=level, **kwargs)
        super().__init__(POINT, level, **kwargs)
