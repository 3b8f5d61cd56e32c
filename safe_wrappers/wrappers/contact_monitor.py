"""ContactMonitor: what the contacts of a MuJoCo env did in each control step, and the next impact."""

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import mujoco
import numpy as np

from safe_wrappers import info as keys
from safe_wrappers.checks import non_negative, positive
from safe_wrappers.control.contact.impact import complementarity_residuals, normal_impulse, peak_force
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.mujoco.contacts import Contacts
from safe_wrappers.plants.queries.next_impact import NextImpact
from safe_wrappers.wrappers.common.layer import Env, Reset
from safe_wrappers.wrappers.common.step_monitor import StepMonitor


class ContactMonitor(StepMonitor):
    """Reports forces, impulses and violations of a MuJoCo env's contacts, and the next impact; changes nothing.

    It sees every physics substep, and every stage of a Runge-Kutta step: each control step is made once more on data
    of its own, from the state before it and with the inputs that the env has left. An env that changes its inputs or
    its state between substeps cannot be replayed.

    Args:
        env: Its unwrapped env has MuJoCo's `.model` and `.data`.
        bodies: Names of the bodies to watch; None watches all.
        against: Names of what they touch, "world" among them; None is everything. A contact counts if one of its
            bodies is in each list.
        restitution: e of every impact, from 0 (plastic) to 1 (elastic); with it the next impact is predicted.
        stiffness: k of every contact, both sides in series, N/m; with it the peak force of that impact, too.

    Info, at every step (0 and False after a reset; not finite where the simulation's contacts are not):
    ``contact/peak_force`` (N), the largest normal force between two bodies, summed over their contacts;
    ``contact/impulse`` (N s) of all watched contacts; ``contact/penetration`` (m), the deepest; ``contact/residual``
    (N m), the largest ``|gap * force|``, 0 for rigid contacts; ``contact/judged`` (int), how many contacts that was;
    ``contact/pull`` (N), the largest force that pulls, and ``contact/open_force`` (N), the largest across an open
    gap, both NaN where none was judged; ``contact/partial`` (bool): not replayed, the figures are those of the
    contacts left behind, for one substep. With `restitution`, of the state after the step or reset:
    ``contact/next_time`` (s) until two geoms touch that do not touch yet, at their present speeds, inf if none
    approach; ``contact/next_impulse`` (N s) and ``contact/next_force`` (N) of that impact alone, NaN without one.

    Raises:
        UnsupportedEnvError: No MuJoCo model, or impacts to predict of a height field or of flexible parts.
        UnknownNameError: No body of that name; the message lists those there are.
        ConfigurationError: Not a list of names, a restitution or stiffness outside its range, a stiffness alone, or a
            `ChunkHandover` inside, whose step is many control steps.

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
        self,
        env: Env,
        bodies: Sequence[str] | None = None,
        against: Sequence[str] | None = None,
        restitution: float | None = None,
        stiffness: float | None = None,
    ) -> None:
        StepMonitor.__init__(self, env)
        raw: Any = env.unwrapped
        self._contacts = Contacts(raw.model, bodies, against)
        self.bodies = None if bodies is None else list(bodies)
        self.against = None if against is None else list(against)
        self._restitution = restitution if restitution is None else _restitution(restitution)
        self._stiffness = stiffness if stiffness is None else positive("stiffness", stiffness, "N/m")
        if restitution is None and stiffness is not None:
            raise ConfigurationError(
                "stiffness is for the impacts that are predicted: give their restitution, too"
            )
        self._next: NextImpact | None = None
        if restitution is not None:
            self._next = NextImpact(raw.model, self._contacts.watched)
        own = {"restitution": self._restitution, "stiffness": self._stiffness}
        self._record({"bodies": self.bodies, "against": self.against, **own})
        self._begin(raw.model)

    @property
    def peak_bodies(self) -> tuple[str, str] | None:
        """Names of the two bodies that had the `contact/peak_force` of the last step; None where there was none."""
        return self._names(self._peak_bodies)

    @property
    def next_bodies(self) -> tuple[str, str] | None:
        """Names of the two bodies of the next impact, after the last step or reset; None where none is predicted."""
        return self._names(self._next_bodies)

    def _names(self, bodies: tuple[int, int] | None) -> tuple[str, str] | None:
        if bodies is None:
            return None
        model = self.unwrapped.model  # type: ignore[attr-defined]
        first, second = (model.body(i).name if i < model.nbody else "" for i in bodies)
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
            if self._next is not None:
                self._next = NextImpact(model, self._contacts.watched)
        self._gaps: list[float] = []
        self._forces: list[float] = []
        self._impulse = self._peak = 0.0
        self._peak_bodies: tuple[int, int] | None = None
        self._next_bodies: tuple[int, int] | None = None

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
        pull: float = keys.NOT_JUDGED
        across: float = keys.NOT_JUDGED
        if self._gaps:
            gaps, forces = np.array(self._gaps), np.array(self._forces)
            if np.isfinite(gaps).all() and np.isfinite(forces).all():
                residuals = complementarity_residuals(gaps, forces)
                depth, residual = float(residuals.penetration.max()), float(residuals.product.max())
                pull = float(residuals.tension.max())
                across = float(np.abs(forces).max(initial=0.0, where=gaps > 0.0))
            else:
                peak = impulse = depth = residual = math.nan
        return {
            keys.CONTACT_PEAK_FORCE: peak,
            keys.CONTACT_IMPULSE: impulse,
            keys.CONTACT_PENETRATION: depth,
            keys.CONTACT_RESIDUAL: residual,
            keys.CONTACT_JUDGED: len(self._gaps),
            keys.CONTACT_PULL: pull,
            keys.CONTACT_OPEN_FORCE: across,
            **self._predicted(data),
        }

    def _predicted(self, data: mujoco.MjData) -> dict[str, float]:
        """The next impact from a state; nothing where none was asked for."""
        if self._next is None:
            return {}
        impact = self._next.of(data)
        self._next_bodies = impact.bodies
        impulse: float = keys.NOT_JUDGED
        force: float = keys.NOT_JUDGED
        if impact.bodies is not None:
            assert self._restitution is not None
            impulse = float(normal_impulse(impact.mass, -impact.speed, self._restitution))
            if self._stiffness is not None:
                force = float(peak_force(impact.speed, impact.mass, self._stiffness))
        return {
            keys.CONTACT_NEXT_TIME: keys.NOT_JUDGED if math.isnan(impact.time_s) else impact.time_s,
            keys.CONTACT_NEXT_IMPULSE: impulse,
            keys.CONTACT_NEXT_FORCE: force,
        }


def _restitution(given: float) -> float:
    value = non_negative("restitution", given, "a share of the speed")
    if value > 1.0:
        raise ConfigurationError(f"restitution is from 0 (plastic) to 1 (elastic), got {given!r}")
    return value
