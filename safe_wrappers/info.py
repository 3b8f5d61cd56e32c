"""The registry of info keys: type, unit and meaning of each, and how it is merged, summed up and logged.

Every wrapper writes its keys at every step with the dtype given here. No key holds a wall-clock value: `check_env`
compares two runs exactly.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np


@dataclass(frozen=True)
class InfoKey:
    """One info key; the docstring of its constant says what it means.

    Attributes:
        shape: Of an array, such as "(3,)" or "(wheels,)"; "" is a number.
        unit: SI, "action" or "reward"; "" without a unit.
        chunk: How `merged` merges the values of several control steps, NaN aside.
        log: `InterventionCallback` logs ``interventions/step_<log>``, the mean over steps and envs; "" is not logged.
    """

    name: str
    dtype: Literal["bool", "int64", "float64", "dict"]
    shape: str = ""
    unit: str = ""
    chunk: Literal["last", "sum", "any", "max", "min"] = "last"
    log: str = ""

    def number(self, value: Any) -> float:
        """The value of a step as one number: of an array the share that is True, or the largest size."""
        if not self.shape:
            return float(value)
        return float(np.mean(value) if self.dtype == "bool" else np.abs(value).max())


@dataclass(frozen=True)
class EpisodeFigure:
    """One figure of an episode: in ``info["interventions"]`` and a column of a run's `episodes.csv`.

    Attributes:
        how: "count" is the number of steps at which a key is above zero, or the sum of a key of whole numbers; "any"
            is whether it ever was.
        of: The info keys that it is made from: for "count" all that exist, else the first that exists.
    """

    name: str
    how: Literal["mean", "p95", "count", "sum", "min", "last", "any"]
    of: tuple[str, ...]


class _NotJudged(np.float64):
    """A NaN that equals every NaN: Gymnasium's `check_env` compares the infos of two equal runs by `==`."""

    def __eq__(self, other: Any) -> bool:
        return isinstance(other, float) and math.isnan(other)

    def __ne__(self, other: Any) -> bool:
        return not self == other

    def __hash__(self) -> int:
        return hash(type(self))

    def __reduce__(self) -> str:
        return "NOT_JUDGED"  # the one below, in a copy and in another process too


NOT_JUDGED: Final = _NotJudged("nan")
"""float64 NaN, written in info for a number that nobody reported; test for it with `math.isnan`."""

KEYS: Final[dict[str, InfoKey]] = {}
"""By name."""


def _key(name: str, dtype: Any, **more: Any) -> str:
    KEYS[name] = InfoKey(name, dtype, **more)
    return name


# CBFActionFilter, every step ------------------------------------------------------------------------------
CBF_INTERVENED: Final = _key("cbf/intervened", "bool", chunk="any", log="rate")
"""The executed action is not the (boxed) proposed one."""
CBF_INFEASIBLE: Final = _key("cbf/infeasible", "bool", chunk="any", log="infeasible")
"""No action that was tried is admitted by every constraint."""
CBF_FALLBACK: Final = _key("cbf/fallback", "bool", chunk="any", log="fallback")
"""The fallback acted: nothing else was admitted, a failed solve, a non-finite proposal or state."""
CBF_NONFINITE: Final = _key("cbf/nonfinite", "bool", chunk="any")
"""The proposed action held a NaN or an infinity; it never reaches the env."""
CBF_CORRECTION: Final = _key("cbf/correction", "float64", unit="action", chunk="max", log="correction")
"""L2 norm of executed minus proposed, boxing included; entries of the proposal that are not finite are taken as 0."""
CBF_MARGIN: Final = _key("cbf/margin", "float64", chunk="min")
"""The smallest barrier value h before the step, in each constraint's unit, margins not taken off; 0 without one."""
CBF_UNSAFE: Final = _key("cbf/unsafe", "bool", chunk="any")
"""Some h was negative (by more than rounding, 1e-6) or not a number before the step."""
CBF_MISMATCH: Final = _key("cbf/mismatch", "bool", chunk="any", log="mismatch")
"""The env's step was not what the filter decided about: another control, time, state or model (`Plant.deviation`)."""
CBF_REFUSED: Final = _key("cbf/refused", "bool", shape="(constraints,)", chunk="any")
"""Which constraints, in the order of `constraint_names`, refused the boxed proposal; all False where it or
the state is not finite."""
CBF_STAGE: Final = _key("cbf/stage", "int64")
"""The `safe_wrappers.filter.search.Stage` that found the executed action: 0 the proposal, 1 projection on rows, 2 a
constraint's candidate, 3 projection on new rows, 4 an overshoot, 5 a blend, 6 a backup control, 7 the fallback, 8 the
least violation."""
EXECUTED_ACTION: Final = _key("executed_action", "float64", shape="(m,)", unit="action")
"""What the env was really given."""
PROPOSED_ACTION: Final = _key("proposed_action", "float64", shape="(m,)", unit="action")
"""What the filter was given, before boxing; entries that are not finite are taken as 0."""

_NUMBERS: Final = [key for key in KEYS.values() if not key.shape]
CBF_BOOLS: Final = tuple(key.name for key in _NUMBERS if key.dtype == "bool")
CBF_FLOATS: Final = tuple(key.name for key in _NUMBERS if key.dtype == "float64")

CBF_STUCK: Final = _key("cbf/stuck", "bool", chunk="any", log="stuck")
"""For `after_s` the filter has changed most actions, and the rewards have not added up to more than `progress`."""

# Traction in a filter, SlipLimiter: every step --------------------------------------------------------------------
SLIP_RATIO: Final = _key("slip/ratio", "float64", shape="(wheels,)", log="slip")
"""Normalised slip of each wheel, in the order of `wheels`, before the step."""
SLIP_MU_ESTIMATE: Final = _key("slip/mu_estimate", "float64", shape="(wheels,)")
"""Estimated peak friction coefficient of each wheel's ground, before the step."""

# ContactFeasibility and SupportMargin in a filter, WholeBodyFilter: every step -------------------------------------
WHOLE_BODY_CONE_MARGIN: Final = _key("whole_body/cone_margin", "float64")
"""How far the contact forces stay inside the narrowed friction cones at worst, forecast for the executed action, as a
share of the robot's weight; negative outside, 0 without contacts."""
WHOLE_BODY_ZMP_MARGIN: Final = _key("whole_body/zmp_margin", "float64", unit="m")
"""Least distance of the zero moment point from the edge of the support polygon in that forecast; 0 without one."""

# Tasks, every step: the env's own truth, never the filter's plant ------------------------------------------
COST: Final = _key("cost", "float64", chunk="sum", log="cost")
"""Cost of this control step, judged at its end, by the task or a `CostFunction`."""
COST_SUBSTEP: Final = _key("cost_substep", "float64", chunk="sum", log="cost_substep")
"""1 if the constraint was violated at any physics substep of this control step, else 0."""
SPIN_OUT: Final = _key("spin_out", "float64", chunk="max", log="spin_out")
"""1 if a loaded wheel spun or locked (slip above 0.5 in size) at any physics substep, else 0."""
COLLISIONS: Final = _key("collisions", "int64", chunk="sum")
"""Collisions that began in this step, one per car or patrol."""
GOALS_REACHED: Final = _key("goals_reached", "int64")
"""Goals reached in this episode so far."""
SUCCESS: Final = _key("success", "bool")
"""Of PointMaze and tasks of others: the goal is reached."""
IS_SUCCESS: Final = _key("is_success", "bool")
"""Of `FlexJointReach-v0` and tasks of others: the goal is reached at the step's end."""

ADAPTION_PENALTY: Final = _key("adaption/penalty", "float64", unit="reward", chunk="sum", log="penalty")
"""What was taken off this step's reward because the filter changed the action; else 0."""

# LeaseExpiry and TeleopChannel without a filter inside, ChunkHandover: every step --------------------------------
ACTION_CLIPPED: Final = _key("action/clipped", "float64", unit="action", chunk="max")
"""L2 norm by which the action left the action space (of a chunk, of the entry that left it farthest); what is
executed was clipped to the space. A filter inside counts that in `cbf/correction`."""

HANDOVER_PEAK_JERK: Final = _key("handover/peak_jerk", "float64", unit="action/s", log="peak_jerk")
"""The largest rate of change between neighbouring executed commands, of any component."""
HANDOVER_STARVED: Final = _key("handover/starved", "int64", log="starved")
"""Control steps of this step at which the queue was empty and the fallback gave the command."""
HANDOVER_LIMITED: Final = _key("handover/limited", "int64", log="limited")
"""Control steps of this step at which `rate_limit` changed a command, beyond the blend."""
HANDOVER_REFUSED: Final = _key("handover/refused", "bool")
"""A chunk was refused: not finite, not newer than the one in force, too late, out of reach, or without a blend that
keeps `limits`."""

LEASE_REMAINING_S: Final = _key("lease/remaining_s", "float64", unit="s")
"""Remaining time of the lease in force after this control step; 0 without a lease."""
LEASE_REFUSED: Final = _key("lease/refused", "bool", chunk="any", log="lease_refused")
"""A command was refused: no lease was granted, or it was not finite, older than that in force or from the future."""
LEASE_BRAKING: Final = _key("lease/braking", "bool", chunk="any", log="lease_braking")
"""The fallback acted at this control step."""

TELEOP_ROUND_TRIP_S: Final = _key("teleop/round_trip_s", "float64", unit="s")
"""Age of the image that the command in force was made from; before the first one, since the reset."""
TELEOP_LOST: Final = _key("teleop/lost", "int64", chunk="sum")
"""Packets of this step that got lost, both ways; actions that are not finite, or from the future, count as lost."""
TELEOP_REVOKED: Final = _key("teleop/revoked", "bool", chunk="any")
"""The operator had no authority, the local brake acted."""
TELEOP_CREATED_J: Final = _key("teleop/created_j", "float64", unit="J")
"""The largest excess of energy out and in flight over energy in, so far; 0 is passive."""

# ContactMonitor, every step: of the watched contacts over the physics substeps of the control step -----------------
CONTACT_PEAK_FORCE: Final = _key("contact/peak_force", "float64", unit="N", chunk="max", log="contact_force")
"""The largest normal force between two bodies, summed over their contacts."""
CONTACT_PENETRATION: Final = _key("contact/penetration", "float64", unit="m", chunk="max")
"""The largest penetration depth."""
CONTACT_RESIDUAL: Final = _key("contact/residual", "float64", unit="N m", chunk="max")
"""The largest ``|gap * force|`` of a contact: the violation of complementarity."""
CONTACT_PARTIAL: Final = _key("contact/partial", "bool", chunk="any")
"""Not every substep was seen; the other keys describe only the last substep."""

# BalanceMonitor, every step: of the robot and its contacts with the fixed world ------------------------------------
BALANCE_LINEAR_MOMENTUM: Final = _key("balance/linear_momentum", "float64", shape="(3,)", unit="kg m/s")
"""After the step."""
BALANCE_ANGULAR_MOMENTUM: Final = _key("balance/angular_momentum", "float64", shape="(3,)", unit="kg m^2/s")
"""About the centre of mass, after the step."""
BALANCE_FRICTION_USED: Final = _key("balance/friction_used", "float64", chunk="max")
"""The largest ``|f_t| / (mu f_n)`` of a contact with at least 1 % of the weight, over all evaluations."""
BALANCE_ZMP_MARGIN: Final = _key("balance/zmp_margin", "float64", unit="m", chunk="min")
"""Least distance of the zero moment point from the edge of the support polygon, negative outside; NaN without one."""
BALANCE_PARTIAL: Final = _key("balance/partial", "bool", chunk="any")
"""Not every evaluation was seen (then only the last one counts), or numbers were not finite (reported as 0)."""

# OcclusionPenalty, every step: one entry per track, after the step ------------------------------------------------
OCCLUSION_VISIBLE: Final = _key("occlusion/visible", "bool", shape="(tracks,)", log="seen")
"""The track was measured at the end of this step (in sight and in range)."""
OCCLUSION_SIGMA: Final = _key("occlusion/sigma", "float64", shape="(tracks,)", unit="m", log="sigma")
"""Standard deviation of the track's estimated position where it is largest."""
OCCLUSION_EXPIRED: Final = _key("occlusion/expired", "bool", shape="(tracks,)", chunk="any", log="expired")
"""Without a measurement `sigmas` standard deviations would cross the tolerance in the next step: no permission."""
OCCLUSION_PENALTY: Final = _key(
    "occlusion/penalty", "float64", unit="reward", chunk="sum", log="occlusion_penalty"
)
"""What was taken off this step's reward."""

FAULT_ACTIVE: Final = _key("fault/active", "bool", chunk="any", log="fault")
"""The policy's action of this step was lost, late or replaced."""

EPISODE: Final = (
    EpisodeFigure("intervention_rate", "mean", (CBF_INTERVENED,)),
    EpisodeFigure("correction_mean", "mean", (CBF_CORRECTION,)),
    EpisodeFigure("correction_p95", "p95", (CBF_CORRECTION,)),
    EpisodeFigure("infeasible", "count", (CBF_INFEASIBLE,)),
    EpisodeFigure("fallback", "count", (CBF_FALLBACK,)),
    EpisodeFigure("nonfinite", "count", (CBF_NONFINITE,)),
    EpisodeFigure("unsafe", "count", (CBF_UNSAFE,)),
    EpisodeFigure("mismatch", "count", (CBF_MISMATCH,)),
    EpisodeFigure("stuck", "count", (CBF_STUCK,)),
    EpisodeFigure("lease_refused", "count", (LEASE_REFUSED,)),
    EpisodeFigure("lease_braking", "count", (LEASE_BRAKING,)),
    EpisodeFigure("margin_min", "min", (CBF_MARGIN,)),
    EpisodeFigure("violations", "count", (COST, COST_SUBSTEP)),
    EpisodeFigure("cost", "sum", (COST,)),
    EpisodeFigure("cost_substep", "sum", (COST_SUBSTEP,)),
    EpisodeFigure("goals_reached", "last", (GOALS_REACHED,)),
    EpisodeFigure("spin_outs", "count", (SPIN_OUT,)),
    EpisodeFigure("success", "any", (SUCCESS, IS_SUCCESS)),
    EpisodeFigure("collisions", "count", (COLLISIONS,)),
    EpisodeFigure("seen", "mean", (OCCLUSION_VISIBLE,)),
)
"""An episode's figures beside its length and return, in the order of `episodes.csv`."""
EPISODE_SUMMARY: Final = _key("interventions", "dict")
"""At an episode's last step only: length, return, and the figures of `EPISODE` that the stack and the task report."""


def merged(infos: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The last control step's info, with each registered key merged over the steps as `InfoKey.chunk` says."""
    last = infos[-1]
    if len(infos) == 1:
        return last
    found: dict[str, Any] = {}
    for name, key in KEYS.items():
        values = [info[name] for info in infos if name in info]
        if key.dtype == "float64" and not key.shape:
            values = [value for value in values if not math.isnan(value)]
        if values and key.chunk != "last":
            value = getattr(np, key.chunk)(values, axis=0)  # the others are NumPy's own names
            array = isinstance(values[-1], np.ndarray)
            found[name] = np.asarray(value, values[-1].dtype) if array else type(values[-1])(value)
    last.update(found)
    return last
