"""Constraint: one safety requirement, as data and a function h of where a control leads."""

from collections.abc import Iterable
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, ClassVar, Literal, Self

import numpy as np

from safe_wrappers.errors import Array, ConfigurationError
from safe_wrappers.plants.plant import Model, Plant

Promise = Literal["proved", "best effort"]
Memory = dict[str, Any]
"""What lasts of an episode: written in one control step, read in the next ones."""


@dataclass(frozen=True, slots=True)
class HalfSpaces:
    """`normals @ u <= offsets`, in physical control units.

    Attributes:
        normals: Shape (k, m). A row that asks for nothing is left out, never padded.
        offsets: Shape (k,).
        provisional: Tangents that are replaced by the constraint's next ones, not joined by them.
    """

    normals: Array
    offsets: Array
    provisional: bool = False

    @staticmethod
    def none(controls: int) -> "HalfSpaces":
        """No rows: nothing is asked for at this state."""
        return HalfSpaces(np.zeros((0, controls)), np.zeros(0))


class Constraint:
    """One safety requirement: `h >= margin` wherever a control leads.

    A subclass is a dataclass: its fields are checked in `__post_init__`, and it writes `h_along`, or `rows` alone.
    Everything else has a default. The filter works with copies, one for every plant.

    A control is admitted if `h` of its trajectory keeps the margin (from outside: comes back towards it). The
    trajectory is that of `model`: the control held for one control interval, and braking after it.

    Attributes:
        promise: What holds for an executed control that is not flagged: "proved" or "best effort".
        margin: Kept free before the limit, in the unit of h.
        state_error: Bound on the error of what is measured, in the same unit. Only its own h or rows count it.
        horizon: Control intervals of the trajectory.
        max_decrease: The most that h can fall within `horizon` control steps; states with more than that left need
            no trajectory. It is checked at every step, and dropped with a warning when broken. None: unknown.
        unit: Of h, for messages.
        plant: Set by `setup`.
        model: What predicts; it has `rollout(control, horizon)`. Set by `setup`: the constraint itself if it is a
            `Model`, else the plant.
        memory: Of the episode.
        report: The info keys of its own, those in `info_keys`; `setup` writes what they are where nothing is known,
            and `observe` or `h_along` what they are in this step, of the executed control in the end.
    """

    promise: Promise = "best effort"
    margin: float = 0.0
    state_error: float = 0.0
    horizon: int = 1
    max_decrease: float | None = None
    unit: ClassVar[str] = "units of h"
    info_keys: ClassVar[tuple[str, ...]] = ()

    predicts: ClassVar[bool] = True
    """Whether h of the trajectory decides."""
    measures_state: ClassVar[bool] = True
    """Whether h says something of the present state."""
    rows_decide: ClassVar[bool] = False
    """Whether the rows are the requirement, or a part of it; else they are a guess that h verifies."""
    recovery_s: ClassVar[float] = 0.1
    """Time constant with which a violation must shrink, s; 0: the next step starts afresh; inf: it must not grow."""
    smooth: ClassVar[bool] = True
    """Whether h changes smoothly with the control, so that tangents are worth their trajectories."""
    rounding: float = 1e-9
    """How far below zero what is left may be and count as rounding."""
    at_rest: ClassVar[float] = 0.0
    """What h of a machine at rest may lose on springy contacts."""
    scale: float = 1.0
    """A typical size of h, to compare constraints of different units."""
    simulates: ClassVar[bool] = False
    """Whether it needs a plant that rolls out policies, `SimulatorPlant` by default."""
    look_ahead_below: float | None = None
    """If this is left now, a control that leaves it in its own step is admitted without a look at the others."""
    euler_look_ahead: bool = False
    """Whether those are looked at by Euler steps."""

    plant: Any
    model: Any
    memory: Memory
    report: dict[str, Any]

    def setup(self, plant: Plant) -> None:
        """Read what is needed of the plant's model, such as ids of names; again when the model has changed.

        Raises:
            UnsupportedEnvError: The plant does not have what the constraint needs.
            ConfigurationError: Names or numbers that do not fit the plant.
        """
        self.plant = plant
        self.model = self if isinstance(self, Model) else plant

    def observe(self, memory: Memory) -> None:
        """Take the plant's present state; `memory["control"]` is what was executed before, if anything was.

        What is written into the memory lasts if a control is executed in this state.
        """

    def h_along(self, path: Any) -> Array:
        """What is left of the limit along a trajectory, in time, margin not taken off: shape (instants, k).

        Also of `model.rollout(None)`: the present state, or for models that stop from there the way to rest. NaN
        counts as lost. k may be 0 where nothing is near.
        """
        return np.zeros((1, 0))

    def rows(self) -> HalfSpaces | None:
        """Half-spaces on the control, or None."""
        return None

    def proposals(self, control: Array | None) -> Iterable[Array]:
        """Controls to try for a refused one, the best first; of None: backups. Only admitted ones are taken."""
        return ()

    def widened(self, margin: float) -> Self:
        """A copy whose margin is wider by this much, in the unit of its margin."""
        if not (is_dataclass(self) and any(f.name == "margin" for f in fields(self))):
            name = type(self).__name__
            raise ConfigurationError(f"{name} has no margin to widen; give it a field `margin`, or margin=0")
        own: Any = self
        wider: Self = replace(own, margin=own.margin + margin)
        return wider
