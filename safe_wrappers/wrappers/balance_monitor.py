"""BalanceMonitor: momentum, friction and support of a legged robot in each control step."""

from collections.abc import Sequence
from typing import Any, ClassVar, Final, SupportsFloat

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers import info as keys
from safe_wrappers.checks import name_list, non_negative, positive
from safe_wrappers.control.contact.friction_cone import normal_and_tangential
from safe_wrappers.control.legged.support_distances import support_distances
from safe_wrappers.errors import ConfigurationError, UnknownNameError, UnsupportedEnvError
from safe_wrappers.plants.mujoco.contacts import ContactForecast, ContactReader, can_touch_the_world
from safe_wrappers.plants.mujoco.model import fixed_bodies
from safe_wrappers.plants.queries.momentum import MomentumReader
from safe_wrappers.stack import Layer
from safe_wrappers.wrappers.common.step_watch import StepWatch

PRESSING: Final = 0.01
"""Share of the robot's weight from which on a contact counts in `balance/friction_used`. Feet that come down or lift
off scrape with next to no pressure, at any ratio, and such a touch carries nothing that could slip. It is what
`ContactFeasibility` tolerates as well."""


class BalanceMonitor(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Reports how a robot on fixed ground keeps its balance; changes nothing.

    Like `ContactMonitor` it makes each control step once more on data of its own, and looks at the contacts of the
    robot with what does not move at every evaluation of the physics, all four of a Runge-Kutta step. The env's data
    is only read, so the physics stays the same bit for bit. The price: a step of HalfCheetah-v5 takes 0.29 ms instead
    of 0.03, of an Ant-v5 on its feet 1.2 ms instead of 0.17.

    **The zero moment point** is where the ground's forces have no tangential moment. There is one only while three or
    more contact points, not on a line, are in one plane (within 1 cm and 0.05 rad) and something presses on it.
    Contacts at several heights, or on a slope and beside it, need the general question whether the wrench is
    feasible; they get no number here, and count as not supported. Since ground only pushes, the point is never beyond
    the hull of the contact points but by what these miss the plane; on its edge the robot begins to tip about it,
    which predicts no particular fall. Close to tipping the far contacts come and go between substeps, and with them
    the polygon: a crate that was pushed with 97 % of what tips it had one at 3 to 6 of 10 evaluations. So look at
    `balance/supported` as well.

    **Friction used** is measured against the round cone. MuJoCo's default cones are pyramids inside it: there a foot
    slides from 0.71 on, depending on the direction. And the model's friction is a number that somebody chose, not a
    measured foothold.

    **Momentum** changes by forces from outside alone: gravity, the ground, things that the robot pushes, and a joint
    that ties it to the world. A planar robot (HalfCheetah, Hopper, Walker2d) is tied so, and stands on a line, which
    is no polygon.

    Put it inside `ChunkHandover`; elsewhere its place does not matter.

    Args:
        env: Its unwrapped env has MuJoCo's `.model` and `.data`.
        friction_share: Of the model's friction coefficient that is taken as the whole, in (0, 1].
        inset: Kept inside the support polygon, m.
        bodies: Names of bodies; the robot is they and all that hangs from them. None is everything that moves, which
            may be more than the robot: name its trunk where something loose lies about.

    Info, at every step (0 and False after a reset):

    - ``balance/linear_momentum`` (float64 array (3,), kg m/s): of the robot after the step.
    - ``balance/angular_momentum`` (float64 array (3,), kg m^2/s): the same about its centre of mass.
    - ``balance/friction_used`` (float): the largest ``|f_t| / (friction_share mu f_n)`` of a contact that carries
      at least 1 % of the robot's weight; contacts without friction (condim 1) have none to use.
    - ``balance/zmp_margin`` (float, m): least distance of the zero moment point from the edge of the support polygon,
      minus the inset; negative within the inset. 0 where there is no polygon.
    - ``balance/supported`` (float): share of the evaluations with a polygon.
    - ``balance/airborne`` (float): share of the evaluations without a contact point.
    - ``balance/partial`` (bool): the step could not be replayed, and the others are of the contacts that it has left
      behind; or it held numbers that are not finite, which are reported as 0.

    Forces are those of contact points. Moments about them (condim 4 and 6: torsional and rolling friction) are left
    out, and so is what an env pushes with by itself: SafeRover's tyres.

    Raises:
        UnsupportedEnvError: No MuJoCo model, or nothing of the robot can touch the fixed world with friction.
        UnknownNameError: No body of that name; the message lists those there are.
        ConfigurationError: A share or an inset out of its range, not a list of names, bodies that do not move, or a
            `ChunkHandover` inside, whose step is many control steps.

    Source: appendix "Centroidal Dynamics and Floating-Base Control".

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> env = sw.BalanceMonitor(gym.make("Ant-v5"))
        >>> _ = env.reset(seed=0)
        >>> infos = [env.step(0 * env.action_space.low)[4] for _ in range(20)]
        >>> infos[0]["balance/airborne"], infos[-1]["balance/supported"] > 0.0
        (1.0, True)

    Change log:
        * v0.1.0: added.
    """

    layer: ClassVar = Layer.MONITOR

    def __init__(
        self,
        env: gym.Env[Any, Any],
        friction_share: float = 1.0,
        inset: float = 0.0,
        bodies: Sequence[str] | None = None,
    ) -> None:
        watch = StepWatch("BalanceMonitor", env, keys.BALANCE_PARTIAL)
        raw: Any = env.unwrapped
        self.friction_share = positive("friction_share", friction_share, "shares of the model's friction")
        if self.friction_share > 1.0:
            raise ConfigurationError(f"friction_share is in (0, 1], got {friction_share}")
        self.inset = non_negative("inset", inset, "m")
        self._robot = _Robot(raw.model, bodies)
        self.bodies = None if bodies is None else list(bodies)
        gym.utils.RecordConstructorArgs.__init__(
            self, friction_share=self.friction_share, inset=self.inset, bodies=self.bodies
        )
        gym.Wrapper.__init__(self, env)
        self._watch = watch

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the env; its info holds the keys of a step, as 0."""
        observation, info = self.env.reset(seed=seed, options=options)
        info.update(_NOTHING | {key: np.zeros(3) for key in _MOMENTA}, **{keys.BALANCE_PARTIAL: False})
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step the env, and look at the forces and the motion of that step."""
        self._watch.before()
        observation, reward, terminated, truncated, info = self.env.step(action)
        raw: Any = self.unwrapped
        if self._robot.model is not raw.model:  # the env has made itself another one, or was unpickled
            self._robot = _Robot(raw.model, self.bodies)
        reader = self._robot.contacts
        reader.clear()
        whole = self._watch.after(lambda data, _: reader.read(data))
        if not whole:
            reader.clear()
            reader.read(raw.data)
        found = self._robot.grounded()
        info.update(_NOTHING if found is None else self._figures(found))
        momentum = self._robot.momentum.read(raw.data)
        info[keys.BALANCE_LINEAR_MOMENTUM] = np.zeros(3) if momentum is None else momentum.linear
        info[keys.BALANCE_ANGULAR_MOMENTUM] = np.zeros(3) if momentum is None else momentum.angular
        info[
            keys.BALANCE_PARTIAL
        ] = not whole  # what is no number is never replayed: it does not equal itself
        return observation, reward, terminated, truncated, info

    def _figures(self, found: ContactForecast) -> dict[str, float]:
        """What finite contacts say."""
        if not found.steps:
            return _NOTHING
        normal, tangential = normal_and_tangential(found.force, found.normal)
        held = self.friction_share * found.friction * normal
        loaded = (normal >= PRESSING * self._robot.weight_n()) & (held > 0.0)
        used = np.linalg.norm(tangential[loaded], axis=1) / held[loaded]
        distances = support_distances(found.step, found.point, found.normal, found.force)
        return {
            keys.BALANCE_FRICTION_USED: float(used.max(initial=0.0)),
            keys.BALANCE_ZMP_MARGIN: float(distances.min()) - self.inset if distances.size else 0.0,
            keys.BALANCE_SUPPORTED: distances.size / found.steps,
            keys.BALANCE_AIRBORNE: (found.steps - np.unique(found.step).size) / found.steps,
        }


_MOMENTA: Final = (keys.BALANCE_LINEAR_MOMENTUM, keys.BALANCE_ANGULAR_MOMENTUM)
_NOTHING: Final = dict.fromkeys(
    (keys.BALANCE_FRICTION_USED, keys.BALANCE_ZMP_MARGIN, keys.BALANCE_SUPPORTED, keys.BALANCE_AIRBORNE), 0.0
)


class _Robot:
    """The bodies that are the robot, and what reads them."""

    def __init__(self, model: mujoco.MjModel, roots: Sequence[str] | None) -> None:
        self.model = model
        self._own = _trees(model, roots)
        moving = self._own & ~fixed_bodies(model) & (model.body_mass > 0.0)
        which = "of this model" if roots is None else f"of bodies={list(roots)}"
        if not moving.any():
            raise ConfigurationError(f"no body {which} moves and has mass")
        if not (can_touch_the_world(model) & self._own).any():
            raise UnsupportedEnvError(
                f"no body {which} can touch the fixed world with friction: there is no balance to report"
            )
        self._massive = np.flatnonzero(moving)
        self.contacts = ContactReader(model)
        self.momentum = MomentumReader(model, self._massive)

    def weight_n(self) -> float:
        """Now: an env may change masses."""
        return float(self.model.body_mass[self._massive].sum() * np.linalg.norm(self.model.opt.gravity))

    def grounded(self) -> ContactForecast | None:
        """Its contacts with the fixed world that have been read; None where they are no finite numbers."""
        found = self.contacts.forecast(finite=True)
        mine = self._own[found.body]
        found = found._replace(
            step=found.step[mine],
            body=found.body[mine],
            point=found.point[mine],
            normal=found.normal[mine],
            force=found.force[mine],
            friction=found.friction[mine],
        )
        finite = all(np.isfinite(array).all() for array in (found.point, found.normal, found.force))
        return found if finite else None


def _trees(model: mujoco.MjModel, roots: Sequence[str] | None) -> NDArray[np.bool_]:
    """Which bodies are, or hang from, the named ones, shape (nbody,); None is all."""
    if roots is None:
        return np.ones(model.nbody, dtype=bool)
    roots = name_list("bodies", roots, "names of bodies", "None for all")
    names = [model.body(i).name for i in range(model.nbody)]
    for name in roots:
        if name not in names:
            there = ", ".join(known for known in names if known)
            raise UnknownNameError(f"bodies: the model has no body {name!r}; it has: {there}")
    own = np.zeros(model.nbody, dtype=bool)
    for i, name in enumerate(names):  # a parent's id is smaller than its children's
        own[i] = name in roots or own[model.body_parentid[i]]
    return own
