"""The motion of named points of a MuJoCo machine, or of one point of an analytic state."""

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.control.numerics.compiled import compiled
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.mujoco.actuators import moment_of
from safe_wrappers.plants.mujoco.model import Remade
from safe_wrappers.plants.mujoco.native import mj_jac, mj_jacDot, mj_solveM
from safe_wrappers.plants.mujoco.plant import MujocoPlant
from safe_wrappers.plants.plant import Plant

_AFFINE_GAIN = int(mujoco.mjtGain.mjGAIN_AFFINE)


@compiled
def _reach(
    model: int,
    data: int,
    body: int,
    point: Array,
    qvel: Array,
    qacc: Array,
    gain_type: Array,
    gain: Array,
    length: Array,
    velocity: Array,
    moment: Array,
    counts: Array,
    starts: Array,
    columns: Array,
    found: Array,
) -> None:
    """Writes one point's numbers of `Points.reaches` into `found`; `model` and `data` are addresses."""
    n, controls = len(qvel), len(length)
    jacobian, rate, solved = np.empty((3, n)), np.empty((3, n)), np.empty((3, n))
    mj_jac(model, data, jacobian.ctypes.data, 0, point.ctypes.data, body)
    mj_jacDot(model, data, rate.ctypes.data, 0, point.ctypes.data, body)
    mj_solveM(model, data, solved.ctypes.data, jacobian.ctypes.data, 3)
    found[:] = 0.0
    for i in range(3):
        found[i] = point[i]
        for j in range(n):
            found[3 + i] += jacobian[i, j] * qvel[j]
            found[6 + i] += jacobian[i, j] * qacc[j] + rate[i, j] * qvel[j]
            for k in range(3):
                found[9 + 3 * i + k] += solved[i, j] * jacobian[k, j]
    forces, responses = np.zeros((controls, n)), np.empty((controls, n))
    for k in range(controls):
        scale = gain[k, 0]
        if gain_type[k] == _AFFINE_GAIN:
            scale += gain[k, 1] * length[k] + gain[k, 2] * velocity[k]
        for place in range(starts[k], starts[k] + counts[k]):
            forces[k, columns[place]] = moment[place] * scale
    mj_solveM(model, data, responses.ctypes.data, forces.ctypes.data, controls)
    for k in range(controls):
        for j in range(n):
            found[18 + k] += forces[k, j] * responses[k, j]


class Points(Remade):
    """Origins of named bodies, sites and geoms (MujocoPlant), or one point of the state (AnalyticPlant).

    `named` has the names by kind; `position` and `velocity` are the indices of the point's coordinates in the state.

    Raises:
        ConfigurationError: No point for this kind of plant, or an unknown name.
    """

    def __init__(
        self,
        plant: Plant,
        named: Mapping[str, Sequence[str]],
        position: Sequence[int],
        velocity: Sequence[int],
    ) -> None:
        self._plant, self._position, self._velocity = plant, list(position), list(velocity)
        self._machine = plant if isinstance(plant, MujocoPlant) else None
        self._named = [(kind, name) for kind, names in named.items() for name in names]
        if self._machine is None:
            if not self._position:
                given = "position=[0, 1], velocity=[2, 3]"
                raise ConfigurationError(f"on an AnalyticPlant say where the point is in the state: {given}")
            return
        if not self._named:
            there = ", ".join(self._machine.names("body"))
            wanted = "name the bodies, sites or geoms to keep clear"
            raise ConfigurationError(f"{wanted}; the model has the bodies {there}")
        for kind, name in self._named:
            self._machine.named(kind, name)
        m, d = self._machine.model, self._machine.data
        self._state = d.qvel, d.qacc, m.actuator_gaintype, m.actuator_gainprm
        self._motors = d.actuator_length, d.actuator_velocity, *moment_of(d)

    @property
    def of_machine(self) -> bool:
        """Whether they are a MuJoCo machine's, so that `reaches` knows them."""
        return self._machine is not None

    @property
    def coordinates(self) -> int:
        """Of each point."""
        return 3 if self.of_machine else len(self._position)

    def motions(self) -> list[tuple[Array, Array]]:
        """Position, m, and velocity, m/s, of each point."""
        if self._machine is not None:
            return [self._machine.motion(kind, name) for kind, name in self._named]
        x = self._plant.state
        return [(x[self._position], x[self._velocity])]

    def reaches(self) -> list[Array]:
        """What controls can do to each point of a machine at most, whatever touches it, shape (18 + nu,) each, SI.

        Position and velocity; the acceleration a0 at the control nearest to zero; the matrix W of accelerations per
        force at the point without contacts and limits, shape (3, 3); for every control k the energy e_k of its unit
        force, its squared length in the inverse of the inertia. A unit of control k changes the acceleration along a
        unit vector n by at most `sqrt(n W n e_k)`: contacts and limits only add to the inertia, and the rest is the
        inequality of Cauchy and Schwarz.
        """
        assert self._machine is not None
        plant, found = self._machine, []
        data = plant.forward()
        for kind, name in self._named:
            numbers = np.empty(18 + plant.lower.size)
            frame = plant.frames.of(kind, name)
            _reach(plant.model._address, data._address, *frame, *self._state, *self._motors, numbers)
            if plant.action_map is not None:  # a unit of action is `scale` units of control
                numbers[18:] *= plant.action_map.scale**2
            found.append(numbers)
        return found

    def accelerations(self) -> list[tuple[Array, Array, Array, Array]]:
        """Position, velocity, drift and control matrix of the acceleration of each point, SI."""
        if self._machine is not None:
            return [self._machine.point(kind, name) for kind, name in self._named]
        x, p, v = self._plant.state, self._position, self._velocity
        return [(x[p], x[v], self._plant.f[v], self._plant.g[v])]
