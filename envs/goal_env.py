"""The goal tasks: reach goals, keep out of hazards, leave vases alone, with a point or a car."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import mujoco
import numpy as np
from gymnasium.spaces import Box
from gymnasium.utils import EzPickle
from numpy.typing import NDArray

from safe_wrappers.errors import Array, ConfigurationError
from safe_wrappers.info import COST, COST_SUBSTEP

from .field import ASSETS, PARKED, FieldEnv
from .goal_robots import CAR, LIDAR_BINS, POINT, Robot, pseudo_lidar
from .layout import PLACE, POSE, Given, parse_layout, place_goal_beside, place_objects, places

HAZARD_RADIUS: Final = 0.2
"""Radius of a hazard's disc, m: the robot's centre must stay outside."""
VASE_SPEED_LIMIT: Final = 1e-4
"""Speed above which a vase counts as moved, m/s (level 2)."""
KEEPOUTS: Final = {"agent": 0.4, "goal": 0.305, "hazards": 0.18, "vases": 0.15}
"""m; like the levels' numbers measured from Safety-Gymnasium 1.2's compiled models, but for level 0."""

_FRAME_SKIP: Final = 10
_REWARD_LIMIT: Final = 10.0
_SLEEP_TOLERANCE: Final = 1e-7  # m/s: a thousandth of the speed that costs
_CAMERA: Final = {"elevation": -65.0, "azimuth": 90.0, "lookat": np.array([0.0, -0.25, 0.0])}
_CAMERA_DISTANCE: Final = 2.8  # in half extents of the field


@dataclass(frozen=True)
class Level:
    """One difficulty of the goal task; a layout may use fewer hazards and vases."""

    hazards: int
    vases: int
    half_extent: float  # m: objects are sampled in the square [-half_extent, half_extent]^2
    vases_cost: bool  # whether touching or moving one costs


LEVELS: Final = (Level(0, 0, 1.0, False), Level(8, 1, 1.5, False), Level(10, 10, 2.0, True))
"""Levels 0, 1 and 2."""


class SafeGoalEnv(FieldEnv):
    """Safety-Gymnasium's goal task on today's MuJoCo: semantics theirs, model and code our own.

    **Levels**: 0 has a goal alone; 1 has 8 hazards and a vase that costs nothing; 2 has 10 hazards and 10
    vases that must not be touched.

    **Observation**: the robot's sensors, then `pseudo_lidar` readings of 16 bins for the goal and, where the
    level has them, for hazards and vases. float64.

    **Reward**: distance to the goal gained in this step (m), plus 1 on coming within 0.3 m of it, clipped
    at 10. Then a new goal is sampled and the episode goes on: `terminated` is never true.

    **Info**, at every step and at reset: ``cost`` (1.0 if `cost_hazards` or `cost_vases`), ``cost_hazards`` (1.0 if
    the robot's centre is inside a hazard's disc), ``cost_vases`` (1.0 if a vase is touched or moves, at level 2),
    ``cost_substep``, ``goal_met``, ``goals_reached``. `cost` is judged at the end of the
    control step, as Safety-Gymnasium publishes it; `cost_substep` after every physics substep, so it also
    sees a hazard's edge cut between two control steps (``cost <= cost_substep``). At reset they judge the
    start state.

    **Layout**: ``reset(options={"layout": {"agent": [x, y, heading], "goal": [x, y], "hazards": [[x, y],
    ...], "vases": [[x, y], ...]}})``; any subset of the keys, the rest is sampled. With fewer hazards or
    vases than the level has, the others are parked far away: no lidar, cost or property knows of them.

    **State**: ``qpos`` holds the robot's coordinates, then x, y, z and a quaternion per vase, in world
    coordinates; `set_state` works as in every Gymnasium MuJoCo env. Vases at rest sleep where MuJoCo knows how
    to (from 3.4 on): without it level 2 is several times slower, and the same to 1e-6 m/s.

    Args:
        robot: The machine.
        level: 0, 1 or 2.
        kwargs: Passed to `gymnasium.envs.mujoco.MujocoEnv`.

    Raises:
        ConfigurationError: There is no such level.
    """

    hazard_radius: Final = HAZARD_RADIUS
    goal_radius = 0.3

    def __init__(self, robot: Robot, level: int, **kwargs: Any) -> None:
        if level not in range(len(LEVELS)):
            raise ConfigurationError(f"level must be one of 0, 1, 2; got {level!r}")
        self.robot = robot
        self.level = LEVELS[level]
        camera = {**_CAMERA, "distance": _CAMERA_DISTANCE * self.level.half_extent}
        self._kinds = 1 + (self.level.hazards > 0) + (self.level.vases > 0)
        bins = self._kinds * LIDAR_BINS
        low = np.concatenate([np.full(robot.n_sensors, -np.inf), np.zeros(bins)])
        high = np.concatenate([np.full(robot.n_sensors, np.inf), np.ones(bins)])
        space = Box(low, high, dtype=np.float64)
        super().__init__(f"{robot.name}_goal{level}.xml", _FRAME_SKIP, space, camera, **kwargs)
        joint = self.model.joint("vase0") if self.level.vases else None
        first = int(joint.qposadr[0]) if joint else self.model.nq
        self._vases_qpos = slice(first, first + 7 * self.level.vases)
        first = int(joint.dofadr[0]) if joint else self.model.nv
        self._vases_qvel = slice(first, first + 6 * self.level.vases)
        self._touch_side = self._sides_of_geoms()
        if hasattr(mujoco.mjtEnableBit, "mjENBL_SLEEP"):
            self.model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)
            self.model.opt.sleep_tolerance = _SLEEP_TOLERANCE
            # With sleeping on, MuJoCo computes the poses of what never moves here alone (3.13 and later).
            mujoco.mj_resetData(self.model, self.data)
        self._apply(np.zeros(3), np.zeros(2), np.zeros((0, 2)), np.zeros((0, 2)))

    @property
    def agent_heading(self) -> float:
        """Where positive controls drive the robot, in [-pi, pi], rad."""
        return self.robot.heading(self.data.qpos)

    @property
    def hazard_positions(self) -> Array:
        """Centres of the hazards in the scenario, shape (n, 2), m."""
        return np.array(self._hazards)

    @property
    def vase_positions(self) -> Array:
        """Centres of the vases in the scenario now, shape (n, 2), m."""
        return np.array(self.data.qpos[self._vases_qpos].reshape(-1, 7)[: self._n_vases, :2])

    @property
    def robot_model(self) -> mujoco.MjModel:
        """The robot alone on the floor, with nothing to hit: for a plant that has only its motion to forecast."""
        return mujoco.MjModel.from_xml_path(str(ASSETS / f"{self.robot.name}_goal0.xml"))

    def _parse(self, options: Mapping[str, Any] | None) -> Given:
        hazards, vases = places(self.level.hazards), places(self.level.vases)
        return parse_layout(options, {"agent": POSE, "goal": PLACE, "hazards": hazards, "vases": vases})

    def reset_model(self) -> Array:
        level = self.level
        counts = {"hazards": level.hazards, "vases": level.vases}
        self._apply(**place_objects(self.np_random, level.half_extent, KEEPOUTS, counts, self._given))
        return self.observe()

    def set_state(self, qpos: Array, qvel: Array) -> None:
        """Set positions and velocities (shapes (nq,), (nv,)) and judge the state anew."""
        super().set_state(qpos, qvel)  # type: ignore[no-untyped-call]
        self._judge_now()

    def _reward(self) -> float:
        return max(-_REWARD_LIMIT, min(_REWARD_LIMIT, super()._reward()))

    def _next_goal(self) -> Array:
        standing = {
            "agent": self.agent_position[None],
            "hazards": self._hazards,
            "vases": self.vase_positions,
        }
        return place_goal_beside(self.np_random, self.level.half_extent, KEEPOUTS, standing)

    def _get_reset_info(self) -> dict[str, Any]:
        return {
            COST: float(self._in_hazard or self._vase_hit),
            COST_SUBSTEP: float(self._violated),
            "cost_hazards": float(self._in_hazard),
            "cost_vases": float(self._vase_hit),
            **super()._get_reset_info(),
        }

    def _step_mujoco_simulation(self, ctrl: Array, n_frames: int) -> None:
        """Step substep by substep, keeping what the judge needs of each; judge them together at the end."""
        model, data, qpos = self.model, self.data, self.data.qpos
        data.ctrl[:] = ctrl
        judge_vases = self.level.vases_cost and self._n_vases > 0
        self._path = path = np.zeros((n_frames, 2))
        touched = moved = moving = False
        for k in range(n_frames):
            mujoco.mj_step(model, data)
            path[k] = qpos[:2]
            if judge_vases:
                moving = self._any_vase_moves()
                moved = moved or moving
                # mj_step integrates after it has looked for contacts, so those in data belong to the substep
                # before: the first ones were judged by the last control step, the last ones follow below.
                touched = touched or (k > 0 and self._any_vase_touched())
        # Sensors and contacts of the state reached; also what Gymnasium calls mj_rnePostConstraint for.
        mujoco.mj_forward(model, data)
        touching = judge_vases and self._any_vase_touched()
        inside = self._inside_hazard(path)
        self._in_hazard = bool(inside[-1])
        self._vase_hit = touching or moving
        self._violated = bool(inside.any()) or moved or touched or touching

    def _judge_now(self) -> None:
        self._in_hazard = bool(self._inside_hazard(self.data.qpos[None, :2])[0])
        judge_vases = self.level.vases_cost and self._n_vases > 0
        self._vase_hit = judge_vases and (self._any_vase_moves() or self._any_vase_touched())
        self._violated = self._in_hazard or self._vase_hit

    def _inside_hazard(self, points: Array) -> NDArray[np.bool_]:
        """Whether each point, shape (n, 2), lies in some hazard's disc; shape (n,)."""
        gaps = points[:, None] - self._hazards
        inside: NDArray[np.bool_] = (np.einsum("ijk,ijk->ij", gaps, gaps) <= HAZARD_RADIUS**2).any(axis=1)
        return inside

    def _any_vase_moves(self) -> bool:
        velocity = self.data.qvel[self._vases_qvel]
        if not velocity.any():  # the usual case: all asleep
            return False
        linear = velocity.reshape(-1, 6)[: self._n_vases, :3]
        return bool((np.einsum("ij,ij->i", linear, linear) > VASE_SPEED_LIMIT**2).any())

    def _any_vase_touched(self) -> bool:
        if not self.data.ncon:
            return False
        return bool((self._touch_side[self.data.contact.geom].sum(axis=1) == 0).any())

    def _sides_of_geoms(self) -> NDArray[np.int8]:
        """+1 for the robot's geoms, -1 for vases, 2 for all else: only a robot-vase pair sums to 0."""
        roots = self.model.body_rootid[self.model.geom_bodyid]
        sides = np.full(self.model.ngeom, 2, dtype=np.int8)
        sides[roots == self.model.body("agent").id] = 1
        for i in range(self.level.vases):
            sides[roots == self.model.body(f"vase{i}").id] = -1
        return sides

    def _apply(self, agent: Array, goal: Array, hazards: Array, vases: Array) -> None:
        """Start an episode from a layout, at rest."""
        self._hazards, self._n_vases = hazards, len(vases)
        # Of the lidars: without hazards, vases are the second.
        self._groups = np.repeat([0, 1, 1 + (self.level.hazards > 0)], [1, len(hazards), len(vases)])
        self._begin(goal, hazards, vases)
        qpos = self.init_qpos.copy()
        self.robot.place(qpos, agent)
        poses = qpos[self._vases_qpos].reshape(-1, 7)
        poses[:, 0] = PARKED
        poses[:, 1] = np.arange(self.level.vases)  # a metre apart, so that parked vases do not touch
        poses[: self._n_vases, :2] = vases
        self.set_state(qpos, np.zeros(self.model.nv))

    def observe(self) -> Array:
        targets = self._targets
        targets[len(targets) - self._n_vases :] = self.vase_positions
        relative = self.robot.relative(targets, self.data.qpos)
        lidar = pseudo_lidar(relative, self._groups, self._kinds)
        return np.concatenate([self.robot.sensors(self.data), lidar])


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

    metadata: dict[str, Any] = {**SafeGoalEnv.metadata, "render_fps": 25}  # noqa: RUF012 (Gymnasium's)

    def __init__(self, level: int = 1, **kwargs: Any) -> None:
        # EzPickle rebuilds the class from these arguments, so it must see this class's signature.
        EzPickle.__init__(self, level=level, **kwargs)
        super().__init__(CAR, level, **kwargs)
