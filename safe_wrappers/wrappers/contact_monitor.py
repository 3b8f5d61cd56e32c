"""ContactMonitor: what the contacts of a MuJoCo env did in each control step."""

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import mujoco
import numpy as np

from safe_wrappers import info as keys
from safe_wrappers.control.contact.contact import complementarity_residuals
from safe_wrappers.plants.mujoco.contacts import Contacts
from safe_wrappers.wrappers.common.layer import Env, Reset
from safe_wrappers.wrappers.common.step_monitor import StepMonitor


class ContactMonitor(StepMonitor):
    """Reports forces, impulses and penetrations of a MuJoCo env's contacts; changes nothing.

    It sees every physics substep, and every stage of a Runge-Kutta step: each control step is made once more on data
    of its own, from the state before it and with the inputs that the env has left. An env that changes its inputs or
    its state between substeps cannot be replayed.

    Args:
        env: Its unwrapped env has MuJoCo's `.model` and `.data`.
        bodies: Names of the bodies to watch; None watches all.
        against: Names of what they touch, "world" among them; None is everything. A contact counts if one of its
            bodies is in each list.

    Info, at every step (0 and False after a reset; not finite where the simulation's contacts are not):
    ``contact/peak_force`` (N), the largest normal force between two bodies, summed over their contacts;
    ``contact/impulse`` (N s) of all watched contacts; ``contact/penetration`` (m), the deepest; ``contact/residual``
    (N m), the largest ``|gap * force|``, 0 for rigid contacts; ``contact/partial`` (bool): not replayed, the figures
    are those of the contacts left behind, for one substep.

    Raises:
        UnsupportedEnvError: No MuJoCo model.
        UnknownNameError: No body of that name; the message lists those there are.
        ConfigurationError: Not a list of names, or a `ChunkHandover` inside, whose step is many control steps.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> env = sw.ContactMonitor(gym.make("HalfCheetah-v5"), against=["world"])
        >>> _ = env.reset(seed=0)
        >>> forces = [env.step(env.action_space.low)[4]["contact/peak_force"] for _ in range(20)]
        >>> max(forces) > 100.0
        True
    """

    partial: ClassVar = keys.CONTACT_PARTIAL

    def __init__(
        self, env: Env, bodies: Sequence[str] | None = None, against: Sequence[str] | None = None
    ) -> None:
        StepMonitor.__init__(self, env)
        raw: Any = env.unwrapped
        self._contacts = Contacts(raw.model, bodies, against)
        self.bodies = None if bodies is None else list(bodies)
        self.against = None if against is None else list(against)
        self._record({"bodies": self.bodies, "against": self.against})
        self._begin(raw.model)

    @property
    def peak_bodies(self) -> tuple[str, str] | None:
        """Names of the two bodies that had the `contact/peak_force` of the last step; None where there was none."""
        if self._peak_bodies is None:
            return None
        model = self.unwrapped.model  # type: ignore[attr-defined]
        first, second = (model.body(i).name if i < model.nbody else "" for i in self._peak_bodies)
        return first, second

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Reset:
        """Reset the env; its info holds the keys of a step, as 0."""
        observation, info = self.env.reset(seed=seed, options=options)
        raw: Any = self.unwrapped
        self._begin(raw.model)
        info.update(self._figures(raw.data), **{self.partial: False})
        return observation, info

    def _begin(self, model: mujoco.MjModel) -> None:
        if self._contacts.model is not model:
            self._contacts = Contacts(model, self.bodies, self.against)
        self._gaps: list[float] = []
        self._forces: list[float] = []
        self._impulse = self._peak = 0.0
        self._peak_bodies: tuple[int, int] | None = None

    def _visit(self, data: mujoco.MjData, time_s: float) -> None:
        pairs: dict[tuple[int, int], float] = {}
        for bodies, gap, force in self._contacts.read(data):
            self._gaps.append(gap)
            self._forces.append(force)
            self._impulse += force * time_s
            pairs[bodies] = pairs.get(bodies, 0.0) + force
        for bodies, force in pairs.items():
            if force > self._peak:
                self._peak, self._peak_bodies = force, bodies

    def _figures(self, data: mujoco.MjData) -> dict[str, Any]:
        peak, impulse, depth, residual = self._peak, self._impulse, 0.0, 0.0
        if self._gaps:
            if np.isfinite(self._gaps).all() and np.isfinite(self._forces).all():
                residuals = complementarity_residuals(self._gaps, self._forces)
                depth, residual = float(residuals.penetration.max()), float(residuals.product.max())
            else:
                peak = impulse = depth = residual = math.nan
        return {
            keys.CONTACT_PEAK_FORCE: peak,
            keys.CONTACT_IMPULSE: impulse,
            keys.CONTACT_PENETRATION: depth,
            keys.CONTACT_RESIDUAL: residual,
        }
