"""HeadingDriveBatch: HeadingDriveClearance in many envs, decided in two compiled calls."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import Array
from safe_wrappers.constraints.backup.base import Detour
from safe_wrappers.control.backup import drive_decision as among
from safe_wrappers.filter.constraint_batch import ConstraintBatch
from safe_wrappers.plants.mujoco.actuators import Actuators, acting_ranges

if TYPE_CHECKING:
    from safe_wrappers.constraints.backup.heading_drive_clearance import BoundHeadingDriveClearance


class HeadingDriveBatch(ConstraintBatch):
    """The robots of n envs; positions and velocities are read from the envs' own data, without a delay.

    Args:
        bound: The constraint on every env's plant, all of one specification.
        low: The action box, shape (2,).
        high: Likewise.
        dtype: Of actions: single or double precision.
    """

    def __init__(
        self, bound: Sequence["BoundHeadingDriveClearance"], low: Array, high: Array, dtype: np.dtype[Any]
    ) -> None:
        n = len(bound)
        self._bound, self._single = list(bound), dtype == np.float32
        self._low, self._high = low, high
        self._sides, self._steps = np.zeros(n), np.zeros(n, dtype=np.int64)
        self._positions: list[Array] = [np.zeros(3)] * n
        self._velocities: list[Array] = [np.zeros(3)] * n
        self._joints, self._motions = np.zeros((2, 3 * n)), np.zeros((n, 6))
        self._origins = np.zeros((n, 2))
        self._counts: list[int] = []
        self._loaded = False
        self._read_constants()

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        for i in range(len(self._bound)):  # a copy reads the data of the copied envs
            self.restart(i, self.memory(i))

    def _pairs(self, controls: Array) -> Array:
        """(Drive, turn) from controls, shape (..., 2); the same swap leads back."""
        return controls[..., ::-1] if self._bound[0].turns_first else controls

    def restart(self, env: int, memory: Detour) -> None:
        bound = self._bound[env]
        self._positions[env], self._velocities[env] = bound.frame.views(bound.plant.published())
        self._origins[env] = bound.frame.place[2:]
        self._sides[env], self._steps[env] = memory

    def memory(self, env: int) -> Detour:
        return Detour(float(self._sides[env]), int(self._steps[env]))

    def decide(
        self, proposals: Array, judged: NDArray[np.bool_], controls: Array
    ) -> tuple[Array, NDArray[np.int64]]:
        self._observe()
        n, one = len(proposals), self._bound[0]
        scene = self._models, self._motions, self._discs, self._first, one.spec.brake, one.reserve
        values, admitted, stages = np.empty(n), np.empty(n, dtype=bool), np.zeros(n, dtype=np.int64)
        pairs = np.ascontiguousarray(self._pairs(proposals))
        among.admit_each(*scene, pairs, values, admitted)
        found, refused = pairs.copy(), np.flatnonzero(judged & ~admitted)
        sides = np.where(self._steps > 0, self._sides, 0.0)
        if refused.size or not self._loaded:  # the first step compiles what a later one would wait for
            self._loaded = True
            bounds, detour = self._bounds(refused), one.spec.detour
            among.decide_each(*scene, pairs, refused, sides, detour, bounds, self._single, found, stages)
        self._tried = np.where(judged & ~admitted, sides, 0.0)
        controls[judged] = self._pairs(found)[judged]
        return values, stages

    def executed(self, envs: NDArray[np.bool_]) -> None:
        detour = envs & (self._tried != 0.0)
        self._sides[detour], self._steps[detour] = self._tried[detour], self._bound[0].detour_steps
        self._steps[envs] -= 1

    def _bounds(self, envs: NDArray[np.int64]) -> Array:
        """The action box, and the part of it where forces still change, as (drive, turn), shape (r, 4, 2)."""
        # Contiguous for any number of envs: else functions are compiled once for one env and again for several.
        bounds, acting, dt = (
            np.empty((len(envs), 4, 2)),
            np.empty((len(envs), 2, 2)),
            self._bound[0].plant.control_dt,
        )
        bounds[:, :2] = self._box[envs]
        turn, on_hinge = self._bound[0].frame.turn_index, np.zeros((2, len(self._bound), 2))
        on_hinge[:, :, turn] = self._turn_gear * self._motions[:, 2::3].T
        acting_ranges(self._actuators, on_hinge[0], on_hinge[1], dt, envs, acting)
        bounds[:, 2:] = np.clip(acting, bounds[:, :1], bounds[:, 1:2])
        return np.ascontiguousarray(self._pairs(bounds))

    def _observe(self) -> None:
        """Take the present motion of every robot, and its discs."""
        np.concatenate(self._positions, out=self._joints[0])
        np.concatenate(self._velocities, out=self._joints[1])
        self._motions[:] = self._joints.reshape(2, -1, 3).swapaxes(0, 1).reshape(-1, 6)
        self._motions[:, :2] += self._origins
        groups = [o.centers(b.plant)[:, :2] for b in self._bound for o in b.spec.obstacles]
        counts = [*map(len, groups)]
        if counts != self._counts:
            discs = [b.discs() for b in self._bound]
            self._counts, self._discs = counts, np.concatenate(discs)
            self._first = np.cumsum([0, *map(len, discs)])
        np.concatenate(groups, out=self._discs[:, :2])

    def _read_constants(self) -> None:
        models = [b.plant.model for b in self._bound]
        self._models = np.array([b.models for b in self._bound])
        self._actuators = Actuators(*map(np.array, zip(*map(Actuators.of, models), strict=True)))
        turn = self._bound[0].frame.turn_index
        self._turn_gear = np.array([m.actuator_gear[turn, 0] for m in models])
        low = [np.maximum(self._low, b.plant.lower) for b in self._bound]
        high = [np.minimum(self._high, b.plant.upper) for b in self._bound]
        self._box = np.stack([low, high], axis=1)
