"""ContactMonitor and BalanceMonitor: what contacts and balance did in each control step."""

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, Final

import mujoco
import numpy as np

from safe_wrappers import info as keys
from safe_wrappers.control.contact import complementarity_residuals, normal_and_tangential
from safe_wrappers.control.legged import support_distances
from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.plants.mujoco.contacts import (
    ContactReader,
    Contacts,
    Replay,
    between,
    can_touch_the_world,
    chosen_bodies,
    on_the_world,
)
from safe_wrappers.plants.mujoco.dynamics import MomentumReader
from safe_wrappers.plants.mujoco.model import fixed_bodies
from safe_wrappers.wrappers.layer import Env, LayerWrapper, Step, mujoco_env
from safe_wrappers.wrappers.stack import Layer


class StepMonitor(LayerWrapper, ABC):
    """Makes each control step of a MuJoCo env once more and visits its physics; warns where it ends elsewhere."""

    layer: ClassVar = Layer.MONITOR
    partial: ClassVar[str]
    """Its info key for steps that could not be replayed."""
    nothing: ClassVar[dict[str, Any]]
    """The other info keys, where there was no contact and no motion."""
    _contacts: ContactReader

    def __init__(self, env: Env) -> None:
        LayerWrapper.__init__(self, env)
        self._raw = mujoco_env(env, type(self).__name__)
        self._replay = Replay(self._raw)

    def _begin(self, observation: Any, info: dict[str, Any], seed: int | None) -> Any:
        info.update(copy.deepcopy(self.nothing), **{self.partial: False})
        self._forget()
        return observation

    def step(self, action: Any) -> Step:
        """Step the env, and look at the physics of that step."""
        self._replay.before()
        answer = self._pass_on(action)
        raw = self._raw
        self._forget()
        whole = self._replay.after(lambda data, _: self._contacts.read(data))
        if not whole:
            message = (
                f"a control step of {raw}, made once more, ends elsewhere: the env changes inputs, state or model "
                "between substeps, or MuJoCo has reset it, or it has actuators with activations under Runge-Kutta; "
                f"only the contacts left behind are read (info[{self.partial!r}])"
            )
            self._warn_once("partial", message)
            self._forget()
            self._contacts.read(raw.data)
        answer[4].update(self._figures(raw.data) | {self.partial: not whole})
        return answer

    @abstractmethod
    def _forget(self) -> None:
        """Forget what was visited; the env may have made itself another model."""

    @abstractmethod
    def _figures(self, data: mujoco.MjData) -> dict[str, Any]:
        """The info of what was visited and of the state after the step."""


class ContactMonitor(StepMonitor):
    """Reports forces and violations of a MuJoCo env's contacts; changes nothing.

    It sees every physics substep, and every stage of a Runge-Kutta step: each control step is made once more on data
    of its own. An env that changes its inputs or its state between substeps cannot be replayed, nor can actuators
    with activations under Runge-Kutta (`contact/partial`).

    Args:
        env: Its unwrapped env has MuJoCo's `.model` and `.data`.
        bodies: Names of the bodies to watch; None watches all.
        against: Names of what they touch, "world" among them; None is everything. A contact counts if one of its
            bodies is in each list.

    Info, at every step: ``contact/peak_force`` (N), ``contact/penetration`` (m), ``contact/residual`` (N m; 0 for
    rigid contacts), NaN where the simulation's contacts are not finite, and ``contact/partial`` (bool), see
    `safe_wrappers.info`. After a reset they are 0 and False.

    Attributes:
        peak_bodies: Names of the two bodies that had the `contact/peak_force` of the last step; None: there was none.

    Raises:
        UnsupportedEnvError: No MuJoCo model.
        UnknownNameError: No body of that name; the message lists those there are.
        ConfigurationError: Not a list of names, or a `ChunkHandover` or `ActionRepeat` inside.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> env = sw.ContactMonitor(gym.make("HalfCheetah-v5"), against=["world"])
        >>> _ = env.reset(seed=0)
        >>> forces = [env.step(env.action_space.low)[4]["contact/peak_force"] for _ in range(20)]
        >>> max(forces) > 100.0
        True
    """

    peak_bodies: tuple[str, ...] | None
    partial: ClassVar = keys.CONTACT_PARTIAL
    nothing: ClassVar = dict.fromkeys(
        (keys.CONTACT_PEAK_FORCE, keys.CONTACT_PENETRATION, keys.CONTACT_RESIDUAL), 0.0
    )

    def __init__(
        self,
        env: Env,
        bodies: Sequence[str] | None = None,
        against: Sequence[str] | None = None,
    ) -> None:
        StepMonitor.__init__(self, env)
        self.bodies, self.against, self._model = bodies, against, None
        self._forget()

    def _forget(self) -> None:
        if self._model is not self._raw.model:
            self._model = self._raw.model
            self._contacts = ContactReader(self._model, between(self._model, self.bodies, self.against))
        self._contacts.clear()
        self.peak_bodies = None

    def _figures(self, data: mujoco.MjData) -> dict[str, Any]:
        found = self._contacts.found()
        if not found.gap.size:
            return dict(self.nothing)
        forces, _ = normal_and_tangential(found.force, found.normal)
        if not (np.isfinite(found.gap).all() and np.isfinite(forces).all()):
            return dict.fromkeys(self.nothing, math.nan)
        penetration, product = complementarity_residuals(found.gap, forces)
        pairs: dict[tuple[int, int, int], float] = {}
        for step, (one, other), force in zip(
            found.step.tolist(), found.bodies.tolist(), forces.tolist(), strict=True
        ):
            key = step, min(one, other), max(one, other)
            pairs[key] = pairs.get(key, 0.0) + force
        peak = max(pairs, key=pairs.__getitem__)
        model = self._raw.model
        names = (model.body(i).name if i < model.nbody else "" for i in peak[1:])
        self.peak_bodies = tuple(names) if pairs[peak] > 0.0 else None
        return {
            keys.CONTACT_PEAK_FORCE: max(pairs[peak], 0.0),
            keys.CONTACT_PENETRATION: float(penetration.max()),
            keys.CONTACT_RESIDUAL: float(product.max()),
        }


PRESSING: Final = 0.01
"""Share of the robot's weight from which on a contact counts in `balance/friction_used`: lighter ones only scrape."""


class BalanceMonitor(StepMonitor):
    """Reports momentum, used friction and support of a robot on fixed ground; changes nothing.

    It sees the physics as `ContactMonitor` does, and the robot's contacts with what does not move. There is a zero
    moment point only while three or more contact points, not on a line, are in one plane (within 1 cm and 0.05 rad)
    and something presses on it. Torsional and rolling friction and forces of the env's own are left out.

    Args:
        env: Its unwrapped env has MuJoCo's `.model` and `.data`.
        bodies: Names of bodies; the robot is they and all that hangs from them. None is everything that moves.

    Info, at every step: ``balance/linear_momentum`` (kg m/s), ``balance/angular_momentum`` (kg m^2/s), arrays (3,),
    ``balance/friction_used``, ``balance/zmp_margin`` (m; NaN without one), and ``balance/partial`` (bool).

    Raises:
        UnsupportedEnvError: No MuJoCo model, or nothing of the robot can touch the fixed world with friction.
        UnknownNameError: No body of that name; the message lists those there are.
        ConfigurationError: Bodies that do not move, or a wrong order.

    Source: appendix "Centroidal Dynamics and Floating-Base Control".

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> env = sw.BalanceMonitor(gym.make("Ant-v5"))
        >>> _ = env.reset(seed=0)
        >>> infos = [env.step(0 * env.action_space.low)[4] for _ in range(20)]
        >>> infos[0]["balance/friction_used"], infos[-1]["balance/friction_used"] > 0.0
        (0.0, True)
    """

    partial: ClassVar = keys.BALANCE_PARTIAL
    nothing: ClassVar = {
        keys.BALANCE_FRICTION_USED: 0.0,
        keys.BALANCE_ZMP_MARGIN: keys.NOT_JUDGED,
        keys.BALANCE_LINEAR_MOMENTUM: np.zeros(3),
        keys.BALANCE_ANGULAR_MOMENTUM: np.zeros(3),
    }

    def __init__(self, env: Env, bodies: Sequence[str] | None = None) -> None:
        StepMonitor.__init__(self, env)
        self._take(bodies)
        self.bodies = None if bodies is None else list(bodies)

    def _take(self, bodies: Sequence[str] | None) -> None:
        """Find the robot in the env's model."""
        model = self._model = self._raw.model
        own = chosen_bodies(model, "bodies", bodies)[:-1]
        for i, parent in enumerate(model.body_parentid):  # a parent's id is smaller than its children's
            own[i] |= own[parent]
        moving = own & ~fixed_bodies(model) & (model.body_mass > 0.0)
        which = "of this model" if bodies is None else f"of bodies={list(bodies)}"
        if not moving.any():
            raise ConfigurationError(f"no body {which} moves and has mass")
        if not (can_touch_the_world(model) & own).any():
            raise UnsupportedEnvError(f"no body {which} can touch the fixed world with friction")
        self._own, self._massive = own, np.flatnonzero(moving)
        self._contacts = ContactReader(model, on_the_world(model, own))
        self._momentum = MomentumReader(model, own)

    def _forget(self) -> None:
        if self._model is not self._raw.model:
            self._take(self.bodies)
        self._contacts.clear()

    def _figures(self, data: mujoco.MjData) -> dict[str, Any]:
        figures: dict[str, Any] = copy.deepcopy(self.nothing)
        momentum = self._momentum.read(data)
        if momentum is not None:
            figures[keys.BALANCE_LINEAR_MOMENTUM] = momentum.linear
            figures[keys.BALANCE_ANGULAR_MOMENTUM] = momentum.angular
        found = self._contacts.found()
        finite = all(np.isfinite(array).all() for array in (found.point, found.normal, found.force))
        return figures | self._of_contacts(found) if finite and found.steps else figures

    def _of_contacts(self, found: Contacts) -> dict[str, Any]:
        """The figures of finite contacts."""
        normal, tangential = normal_and_tangential(found.force, found.normal)
        held = found.friction * normal
        gravity = np.linalg.norm(self._model.opt.gravity)
        weight_n = self._model.body_mass[self._massive].sum() * gravity  # now: an env may change masses
        loaded = (normal >= PRESSING * weight_n) & (held > 0.0)
        used = np.linalg.norm(tangential[loaded], axis=1) / held[loaded]
        distances = support_distances(found.step, found.point, found.normal, found.force)
        return {
            keys.BALANCE_FRICTION_USED: float(used.max(initial=0.0)),
            keys.BALANCE_ZMP_MARGIN: float(distances.min()) if distances.size else keys.NOT_JUDGED,
        }
