"""PointMaze with patrols: discs that go up and down its corridors, hidden by its walls."""

import math
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.control.estimation import Motion, Tracks
from safe_wrappers.errors import Array
from safe_wrappers.info import COLLISIONS, COST, COST_SUBSTEP

from .traffic import CAR_SPEED_STD, CAR_TIME_CONSTANT_S, Traffic

try:
    from gymnasium_robotics.envs.maze.maps import U_MAZE
    from gymnasium_robotics.envs.maze.point_maze import PointMazeEnv
except ImportError as error:
    raise ImportError(
        "PatrolledPointMaze is built on gymnasium-robotics' PointMaze: pip install gymnasium-robotics"
    ) from error


BALL_RADIUS: Final = 0.1
PATROL_RADIUS: Final = 0.15
"""m."""
PATROL_MEAN_SPEED: Final = 0.5
"""m/s, up and down the corridor."""
PATROL_REVERSION_S: Final = CAR_TIME_CONSTANT_S
PATROL_ACCELERATION_NOISE: Final = 2.0 * (PATROL_MEAN_SPEED**2 + CAR_SPEED_STD**2) / PATROL_REVERSION_S
"""Intensity of acceleration noise along the corridor, m^2/s^3, for a tracker whose velocity goes back to 0 with
`PATROL_REVERSION_S`: in the long run as much velocity as a patrol has, turns at its ends included."""
START_GAP: Final = 0.3
"""m: no patrol starts closer to the ball than that."""

_CONTACT: Final = BALL_RADIUS + PATROL_RADIUS
_HEIGHT: Final = 0.1  # m: half of a patrol's, drawn about the ball's own height
_COLOUR: Final = (1.0, 0.5, 0.0, 1.0)
_CAMERA: Final = {"elevation": -75.0}  # from lower the walls would hide the patrols
_TRIES: Final = 1000
U_MAZE_PATROLS: Final = (((1, 1), (1, 3)), ((3, 1), (3, 3)))
"""The two long corridors of the U maze, each from its first cell to its last (row, column)."""


class PatrolledPointMazeEnv(PointMazeEnv):  # type: ignore[misc]
    """gymnasium-robotics' PointMaze with discs that patrol; the ball's physics, observations and rewards stay.

    Two patrols (radius 0.15 m) go up and down the two long corridors of the U maze, on the straight line between the
    centres of their first and last cells. Their speeds wander about 0.5 m/s by the law of the crossing's cars
    (standard deviation 0.15 m/s, time constant 2 s; `safe_wrappers.envs.traffic`), drawn without a discretisation
    error; at an end they turn about, as a ball off a wall. Patrols are no bodies of the model: they pass through the
    ball, and walls hide them from whoever looks along the floor. The observation has nothing of them. Frames show
    them in orange, in the renderer's scene alone: model and data stay bit for bit as they are.

    **Attributes**: `patrol_positions` and `patrol_velocities`, shape (2, 2), m and m/s; `patrol_tracks` (a
    `control.estimation.Tracks`): the same as tracks that are known exactly now. `agent_position`,
    `agent_velocity`.

    **Info**, at every step and at reset: ``cost`` and its equal ``cost_substep`` (1.0 if ball and patrol overlapped
    anywhere in the step: closest approach of the straight ways from one physics step to the next), ``collisions``.

    **Randomness**: the seed alone decides the patrols' way, whatever the ball does, but for where it starts: a patrol
    starts at least 0.3 m off the ball.

    Args:
        kwargs: Passed to PointMaze (``reward_type``, ``continuing_task``, ``reset_target``, ``render_mode``, ...).

    Example:
        >>> import gymnasium as gym, safe_wrappers
        >>> env = gym.make("PatrolledPointMaze-v0")
        >>> _ = env.reset(seed=0)
        >>> env.unwrapped.patrol_positions.shape
        (2, 2)
    """

    ball_radius: Final = BALL_RADIUS
    patrol_radius: Final = PATROL_RADIUS

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(maze_map=[list(row) for row in U_MAZE], **kwargs)
        self._ezpickle_args = ()
        self._ezpickle_kwargs = kwargs
        ends = [[self.maze.cell_rowcol_to_xy(np.array(cell)) for cell in way] for way in U_MAZE_PATROLS]
        self._starts, offsets = np.array(ends, dtype=np.float64)[:, 0], np.diff(ends, axis=1)[:, 0]
        self._lengths = np.hypot(*offsets.T)
        self._directions = offsets / self._lengths[:, None]
        self._traffic = Traffic(np.full(len(ends), PATROL_MEAN_SPEED), self.dt, 1)
        # Where each would be on a way without turns, and its speed along it.
        self._gone, self._speeds = np.zeros(len(ends)), np.full(len(ends), PATROL_MEAN_SPEED)
        self._patrols_random = np.random.default_rng(0)  # until the first reset
        motions = [
            Motion(PATROL_ACCELERATION_NOISE * np.outer(along, along), PATROL_REVERSION_S, np.zeros(2))
            for along in self._directions
        ]
        self._tracks = Tracks(motions)
        self._touching = np.zeros(len(ends), dtype=bool)
        renderer = self.point_env.mujoco_renderer
        renderer.default_cam_config = {**renderer.default_cam_config, **_CAMERA}

    def render(self) -> Any:
        """A frame with the patrols."""
        self._mark_patrols()
        return super().render()

    def _mark_patrols(self) -> None:
        """Have the next frame show the patrols."""
        viewer = self.point_env.mujoco_renderer._get_viewer(self.render_mode)
        size, colour = np.array([PATROL_RADIUS, PATROL_RADIUS, _HEIGHT]), np.array(_COLOUR)
        for place in self.patrol_positions:
            pos = np.append(place, 0.0)
            viewer.add_marker(type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=size, pos=pos, rgba=colour)

    @property
    def dt(self) -> float:
        """Of a control step, which is one physics step, s."""
        return float(self.model.opt.timestep)

    @property
    def agent_position(self) -> Array:
        """The ball's centre, shape (2,), m."""
        return np.array(self.data.qpos[:2])

    @property
    def agent_velocity(self) -> Array:
        """Shape (2,), m/s."""
        return np.array(self.data.qvel[:2])

    @property
    def patrol_positions(self) -> Array:
        """Centres, shape (k, 2), m: the truth that no driver may see."""
        return np.asarray(self._starts + self._along()[0][:, None] * self._directions)

    @property
    def patrol_velocities(self) -> Array:
        """Shape (k, 2), m/s: as true."""
        return np.asarray(self._along()[1][:, None] * self._directions)

    @property
    def patrol_tracks(self) -> Tracks:
        """True states, without uncertainty now, and a model of how they move: what a perfect tracker would know."""
        states = np.concatenate([self.patrol_positions, self.patrol_velocities], axis=1)
        self._tracks.start(states, np.zeros((len(states), 4, 4)))
        return self._tracks

    def _along(self) -> tuple[Array, Array]:
        """Way from the start, m, and speed along it, m/s, folded back at both ends."""
        around = np.mod(self._gone, 2.0 * self._lengths)
        back = around > self._lengths
        return np.where(back, 2.0 * self._lengths - around, around), np.where(back, -1.0, 1.0) * self._speeds

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, Any]]:
        """Reset PointMaze and draw where each patrol is, and how fast."""
        observation, info = super().reset(seed=seed, options=options)
        # A stream of the patrols' own, of which PointMaze's draws (of goals) know nothing, nor the patrols of theirs.
        (own,) = self.np_random.bit_generator.seed_seq.spawn(1)
        self._patrols_random = np.random.default_rng(own)
        self._draw_starts()
        self._touching = np.zeros(len(self._gone), dtype=bool)
        offset = self.patrol_positions - self.agent_position
        self._judge(info, offset, offset)
        return observation, info

    def _draw_starts(self) -> None:
        rng = self._patrols_random
        self._speeds = rng.normal(PATROL_MEAN_SPEED, CAR_SPEED_STD, len(self._gone))
        for i in range(len(self._gone)):
            for _ in range(_TRIES):
                self._gone[i] = rng.uniform(0.0, 2.0 * self._lengths[i])
                if math.dist(self.patrol_positions[i], self.agent_position) >= _CONTACT + START_GAP:
                    break

    # PointMaze's step has no annotations; its numbers are Python's.
    def step(
        self, action: NDArray[np.floating[Any]]
    ) -> tuple[dict[str, Array], float, bool, bool, dict[str, Any]]:
        """Step PointMaze, move the patrols, and judge the whole way."""
        before = self.patrol_positions - self.agent_position
        if self.render_mode == "human":  # the robot's own step draws
            self._mark_patrols()
        observation, reward, terminated, truncated, info = super().step(action)
        if self._traffic.step_s != self.dt:
            self._traffic = Traffic(np.full(len(self._gone), PATROL_MEAN_SPEED), self.dt, 1)
        self._gone, self._speeds = self._traffic.drive(self._patrols_random, self._gone, self._speeds)[0]
        self._judge(info, before, self.patrol_positions - self.agent_position)
        return observation, float(reward), bool(terminated), bool(truncated), info

    def _judge(self, info: dict[str, Any], before: Array, after: Array) -> None:
        """Judge straight ways between two offsets of the patrols from the ball, shape (k, 2), m."""
        touched = closest_approach(before, after) <= _CONTACT
        info[COST] = info[COST_SUBSTEP] = float(touched.any())
        info[COLLISIONS] = int((touched & ~self._touching).sum())
        self._touching = np.hypot(*after.T) <= _CONTACT


def closest_approach(before: Array, after: Array) -> Array:
    """Least distance from the origin of straight ways from `before` to `after`, shapes (k, 2); shape (k,), m."""
    way = after - before
    squared = (way * way).sum(axis=1)
    share = -(before * way).sum(axis=1) / np.where(squared > 0.0, squared, 1.0)
    nearest = before + np.clip(share, 0.0, 1.0)[:, None] * way
    return np.asarray(np.hypot(*nearest.T))
