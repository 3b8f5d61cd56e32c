"""ContactMonitor: what the contacts of a MuJoCo env did in each control step."""

import math
from collections.abc import Sequence
from typing import Any, ClassVar, SupportsFloat

import gymnasium as gym
import numpy as np

from safe_wrappers import info as keys
from safe_wrappers.control.contact.contact import complementarity_residuals
from safe_wrappers.plants.mujoco.contacts import Contacts, NormalContact
from safe_wrappers.stack import Layer
from safe_wrappers.wrappers.common.step_watch import StepWatch


class ContactMonitor(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Reports forces, impulses and penetrations of a MuJoCo env's contacts; changes nothing.

    It sees every physics substep, and every stage of a Runge-Kutta step: each control step is made once more on
    data of its own, from the state before it and with the inputs (controls, applied forces) that the env has left.
    The env's data is only read, so the physics stays the same bit for bit. The price is the time of the physics once
    more, and about 10 microseconds per substep, 40 with Runge-Kutta, for reading.

    An env that changes its inputs or its state between substeps cannot be replayed so. The replay then ends
    elsewhere, which is noticed: `contact/partial` is True for that step, a warning says so once, and the figures are
    those of the contacts that the env's step has left behind, most often its last substep's.

    **Soft contacts.** MuJoCo's contacts are springs and dampers, whose force comes from a penetration or, with a
    contact margin, from a gap. They never pull, but they miss complementarity: `contact/residual` is the largest
    ``|gap * force|``, 0 for rigid contacts. It says how rigid the model's contacts are, not how true the model is.

    Put it inside `ChunkHandover`; elsewhere its place does not matter.

    Args:
        env: Its unwrapped env has MuJoCo's `.model` and `.data`.
        bodies: Names of the bodies to watch; None watches all.
        against: Names of what they touch, "world" among them; None is everything. A contact counts if one of its
            bodies is in each list.

    Info, at every step (0 and False after a reset):

    - ``contact/peak_force`` (float, N): the largest normal force between two bodies, summed over their contacts:
      how a foot's force is shared among its contact points says little, and depends on the solver.
    - ``contact/impulse`` (float, N s): normal forces of all watched contacts, summed and integrated over the step.
    - ``contact/penetration`` (float, m): the deepest.
    - ``contact/residual`` (float, N m): the largest ``|gap * force|`` of a contact.
    - ``contact/partial`` (bool): the step could not be replayed; the others are of the contacts that it has left
      behind, for one substep.

    Where the simulation's contacts are not finite numbers, neither is what is reported of them. Bodies that MuJoCo
    has put to sleep have no contacts.

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

    Change log:
        * v0.1.0: added.
    """

    layer: ClassVar = Layer.MONITOR

    def __init__(
        self,
        env: gym.Env[Any, Any],
        bodies: Sequence[str] | None = None,
        against: Sequence[str] | None = None,
    ) -> None:
        watch = StepWatch("ContactMonitor", env, keys.CONTACT_PARTIAL)
        raw: Any = env.unwrapped
        self._contacts = Contacts(raw.model, bodies, against)
        self.bodies = None if bodies is None else list(bodies)
        self.against = None if against is None else list(against)
        gym.utils.RecordConstructorArgs.__init__(self, bodies=self.bodies, against=self.against)
        gym.Wrapper.__init__(self, env)
        self._watch = watch
        self._seen = _Seen()

    @property
    def peak_bodies(self) -> tuple[str, str] | None:
        """Names of the two bodies that had the `contact/peak_force` of the last step; None where there was none."""
        if self._seen.peak_bodies is None:
            return None
        model = self.unwrapped.model  # type: ignore[attr-defined]
        first, second = (model.body(i).name if i < model.nbody else "" for i in self._seen.peak_bodies)
        return first, second

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the env; its info holds the keys of a step, as 0."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._seen = _Seen()
        self._seen.write(info, partial=False)
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step the env, and look at the contacts of that step."""
        self._watch.before()
        observation, reward, terminated, truncated, info = self.env.step(action)
        raw: Any = self.unwrapped
        if self._contacts.model is not raw.model:  # the env has made itself another one, or was unpickled
            self._contacts = Contacts(raw.model, self.bodies, self.against)
        contacts, seen = self._contacts, _Seen()
        whole = self._watch.after(lambda data, time_s: seen.add(contacts.read(data), time_s))
        if not whole:
            seen = _Seen()
            seen.add(contacts.read(raw.data), float(raw.model.opt.timestep))
        self._seen = seen
        seen.write(info, partial=not whole)
        return observation, reward, terminated, truncated, info


class _Seen:
    """What was seen of one control step."""

    def __init__(self) -> None:
        self._gaps: list[float] = []
        self._forces: list[float] = []
        self._impulse = self._peak = 0.0
        self.peak_bodies: tuple[int, int] | None = None

    def add(self, contacts: list[NormalContact], time_s: float) -> None:
        """Contacts that act for some time."""
        pairs: dict[tuple[int, int], float] = {}
        for bodies, gap, force in contacts:
            self._gaps.append(gap)
            self._forces.append(force)
            self._impulse += force * time_s
            pairs[bodies] = pairs.get(bodies, 0.0) + force
        for bodies, force in pairs.items():
            if force > self._peak:
                self._peak, self.peak_bodies = force, bodies

    def write(self, info: dict[str, Any], partial: bool) -> None:
        """As info."""
        peak, impulse, depth, residual = self._peak, self._impulse, 0.0, 0.0
        if self._gaps:
            if np.isfinite(self._gaps).all() and np.isfinite(self._forces).all():
                residuals = complementarity_residuals(self._gaps, self._forces)
                depth, residual = float(residuals.penetration.max()), float(residuals.product.max())
            else:
                peak = impulse = depth = residual = math.nan
        info[keys.CONTACT_PEAK_FORCE] = peak
        info[keys.CONTACT_IMPULSE] = impulse
        info[keys.CONTACT_PENETRATION] = depth
        info[keys.CONTACT_RESIDUAL] = residual
        info[keys.CONTACT_PARTIAL] = partial
