"""The motion of named points of a MuJoCo machine, or of one point of an analytic state."""

from collections.abc import Mapping, Sequence

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
    def coordinates(self) -> int:
        """Of each point."""
        return len(self._position) if self._machine is None else 3

    def motions(self) -> list[tuple[Array, Array]]:
        """Position, m, and velocity, m/s, of each point."""
        if self._machine is not None:
            return [self._machine.motion(kind, name) for kind, name in self._named]
        x = self._plant.state
        return [(x[self._position], x[self._velocity])]

    def accelerations(self) -> list[tuple[Array, Array, Array, Array]]:
        """Position, velocity, drift and control matrix of the acceleration of each point, SI."""
        if self._machine is not None:
            return [self._machine.point(kind, name) for kind, name in self._named]
        x, p, v = self._plant.state, self._position, self._velocity
        return [(x[p], x[v], self._plant.f[v], self._plant.g[v])]
