"""The motion of named points of a MuJoCo machine, or of one point of an analytic state."""

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.mujoco.plant import MujocoPlant
from safe_wrappers.plants.plant import Plant


class Points:
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
        model, data = plant.model, plant.forward()
        gain, _ = plant.actuators.gain_and_bias(data.actuator_length, data.actuator_velocity)
        forces = plant.actuators.moment(data) * gain[:, None]
        if plant.action_map is not None:
            forces *= plant.action_map.scale[:, None]
        responses, solved = np.empty_like(forces), np.empty((3, model.nv))
        mujoco.mj_solveM(model, data, responses, forces)
        energies = (forces * responses).sum(axis=1)
        for kind, name in self._named:
            p, jacobian = plant.frames.jacobian(kind, name)
            rate = plant.frames.jacobian_rate(kind, name)
            mujoco.mj_solveM(model, data, solved, jacobian)
            drift = jacobian @ data.qacc + rate @ data.qvel
            parts = p, jacobian @ data.qvel, drift, (solved @ jacobian.T).ravel(), energies
            found.append(np.concatenate(parts))
        return found

    def accelerations(self) -> list[tuple[Array, Array, Array, Array]]:
        """Position, velocity, drift and control matrix of the acceleration of each point, SI."""
        if self._machine is not None:
            return [self._machine.point(kind, name) for kind, name in self._named]
        x, p, v = self._plant.state, self._position, self._velocity
        return [(x[p], x[v], self._plant.f[v], self._plant.g[v])]
