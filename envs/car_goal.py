"""The goal task with the car: ``SafeCarGoal0-v0``, ``SafeCarGoal1-v0``, ``SafeCarGoal2-v0``."""

from typing import Any

from gymnasium.utils import EzPickle

from .goal.car import CAR
from .goal_env import SafeGoalEnv


class SafeCarGoalEnv(SafeGoalEnv):
    """`SafeGoalEnv` with a car: a torque on each of its two wheels.

    **Action**: ``Box(-1, 1, (2,))``, the torques of the joints ``"left"`` and ``"right"`` in N m, clipped at 0.02:
    in effect full torque one way or the other. Equal positive controls drive the car straight along its heading;
    more of control 0 turns it to the left (the original's wheels are named as seen from the front). Wheels are
    damped (0.001 N m s): at full torque one in the air ends at 20 rad/s, 1 m/s at its rim. Full torque is 0.4 N
    at the rim of each wheel, and all of the car weighs 0.3 N: the wheels slip. Without torque it brakes through
    its wheels.

    **Observation**: accelerometer 3 (m/s^2), velocimeter 3 (m/s), gyro 3 (rad/s), magnetometer 3, turning speed of
    the ball caster 3 (rad/s), its orientation as a rotation matrix 9 (by rows), then the lidars of `SafeGoalEnv`. 40
    numbers at level 0, 72 at levels 1 and 2. All are in the body's frame: x along the axle, to the left of the
    heading, -y along the heading. A lidar's bin 0 begins at x, so bin 12 begins straight ahead.

    **State**: `qpos` begins with the car's x, y, z and quaternion, the angles of the left and the right wheel (rad)
    and the caster's quaternion; `qvel` with six velocities of the free joint, two of the wheels, three of the caster.
    `agent_position` is the body's origin, which is what hazards judge; `agent_heading` the direction of -y.

    **Time**: a control step is ten physics substeps of 4 ms, 0.04 s; 1000 steps are 40 s.

    Args:
        level: 0, 1 or 2; see `SafeGoalEnv`.
        kwargs: Passed to `SafeGoalEnv` (``render_mode``, ``width``, ``height``, ``camera_name``, ...).
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (Gymnasium declares it on the instance)
        **SafeGoalEnv.metadata,
        "render_fps": 25,
    }

    def __init__(self, level: int = 1, **kwargs: Any) -> None:
        # EzPickle rebuilds the class from these arguments, so it must see this class's signature.
        EzPickle.__init__(self, level=level, **kwargs)
        super().__init__(CAR, level, **kwargs)
