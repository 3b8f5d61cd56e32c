"""The one place that names the info keys: their dtypes, units and meaning.

Every wrapper writes its keys at every step with the dtype given here, so that `Monitor`, TensorBoard and
Gymnasium's vector envs need no glue. No key holds a wall-clock value: `check_env` compares two runs exactly.
"""

from typing import Final

# CBFActionFilter, every step ------------------------------------------------------------------------------
CBF_INTERVENED: Final = "cbf/intervened"
"""bool: the executed action is not the (boxed) proposed one."""
CBF_INFEASIBLE: Final = "cbf/infeasible"
"""bool: no action inside the actuator box satisfied every row at this step."""
CBF_FALLBACK: Final = "cbf/fallback"
"""bool: the fallback chose the executed action (infeasible, failed solve, non-finite proposal or state)."""
CBF_NONFINITE: Final = "cbf/nonfinite"
"""bool: the proposed action held a NaN or an infinity; it never reaches the env."""
CBF_CORRECTION: Final = "cbf/correction"
"""float64: L2 norm of executed minus proposed, in action units (boxing counts; 0 for a non-finite proposal's
missing entries: those are compared as 0)."""
CBF_CLIPPED: Final = "cbf/clipped"
"""float64: L2 norm of boxed minus proposed, in action units: what the action space alone took away."""
CBF_MARGIN: Final = "cbf/margin"
"""float64: the smallest barrier value h over all constraints before the step, each in its own unit (m, rad/s,
...), to the limit itself: a constraint's margin is not taken off. 0 when no constraint has a barrier, or nothing
that it watches is there."""
CBF_UNSAFE: Final = "cbf/unsafe"
"""bool: some h was negative (by more than rounding, 1e-6) or not a number before the step."""
CBF_REFUSED: Final = "cbf/refused"
"""bool array, one per constraint in the order of the filter's `constraint_names`: it did not admit the boxed
proposal. More than one may; all False when nothing was changed, or when the state or the proposal was not finite."""
CBF_STAGE: Final = "cbf/stage"
"""int64: which stage of the search found the executed action, a `safe_wrappers.filter.search.Stage`: 0 the proposal
itself, 1 projection on rows, 2 a constraint's candidate, 3 projection on rows linearised anew, 4 an overshoot, 5 a
blend, 6 a backup control, 7 the fallback, 8 the least violation."""
EXECUTED_ACTION: Final = "executed_action"
"""array: what the env was really given."""
PROPOSED_ACTION: Final = "proposed_action"
"""array: what the filter was given, before boxing."""

CBF_BOOLS: Final = (CBF_INTERVENED, CBF_INFEASIBLE, CBF_FALLBACK, CBF_NONFINITE, CBF_UNSAFE)
CBF_FLOATS: Final = (CBF_CORRECTION, CBF_CLIPPED, CBF_MARGIN)

# Traction in a filter, SlipLimiter: every step --------------------------------------------------------------------
SLIP_RATIO: Final = "slip/ratio"
"""float64 array, one per wheel in the order of `wheels`: normalised slip before the step."""
SLIP_LIMITED: Final = "slip/limited"
"""bool array, one per wheel: the filter changed a control that drives it."""
SLIP_MU_ESTIMATE: Final = "slip/mu_estimate"
"""float64 array, one per wheel: estimated peak friction coefficient of its ground, before the step."""
SLIP_MU_STD: Final = "slip/mu_std"
"""float64 array, one per wheel: the estimate's standard deviation (of its model; no error bound)."""

# ContactFeasibility and SupportMargin in a filter, WholeBodyFilter: every step -------------------------------------
WHOLE_BODY_CONTACTS: Final = "whole_body/contacts"
"""int64: contacts of the robot with the fixed world at the state before the step."""
WHOLE_BODY_CONE_MARGIN: Final = "whole_body/cone_margin"
"""float64: by how much the contact forces stay inside the narrowed friction cones at worst, forecast for the executed
action over its control step, as a share of the robot's weight; negative outside, 0 where nothing touches."""
WHOLE_BODY_ZMP_MARGIN: Final = "whole_body/zmp_margin"
"""float64: m, least distance of the zero moment point from the edge of the support polygon, forecast for the executed
action, while there is a polygon; 0 where there is none."""
WHOLE_BODY_SUPPORTED: Final = "whole_body/supported"
"""float64: share of the forecast's instants at which there is a polygon: three contact points of one plane."""

# Tasks, every step: the env's own truth, never the filter's plant ------------------------------------------
COST: Final = "cost"
"""float64: cost of this control step, judged at its end, as Safety-Gymnasium publishes it; `CostFunction` writes it
for a task that reports none."""
COST_SUBSTEP: Final = "cost_substep"
"""float64: 1 if the constraint was violated at any physics substep of this control step, else 0."""
SPIN_OUT: Final = "spin_out"
"""float64: 1 if a loaded wheel spun or locked (slip above 0.5 in size) at any physics substep, else 0."""
COLLISIONS: Final = "collisions"
"""int64: collisions that began in this step."""

# RecordInterventions ---------------------------------------------------------------------------------------
EPISODE_SUMMARY: Final = "interventions"
"""dict, at an episode's last step only, as RecordEpisodeStatistics adds `episode`."""
RUNNING_PREFIX: Final = "interventions/"
RUNNING: Final = (
    "interventions/rate",
    "interventions/correction_mean",
    "interventions/infeasible",
    "interventions/fallback",
    "interventions/margin_min",
    "interventions/cost",
    "interventions/cost_substep",
)
"""float64, every step: the episode so far, NaN where the task or the stack does not report what it is made from.
Monitor reads them at the terminal step (`info_keywords`)."""

# AdaptionPenalty, every step --------------------------------------------------------------------------------
ADAPTION_PENALTY: Final = "adaption/penalty"
"""float64: what was taken off this step's reward because the filter changed the action, in reward units; else 0."""
ADAPTION_TASK_REWARD: Final = "adaption/task_reward"
"""float64: the task's own reward of this step, before the penalty."""

# ChunkHandover, every step: of its chunk of control steps --------------------------------------------------------
HANDOVER_SEAM_JUMP: Final = "handover/seam_jump"
"""float64, shape (3,): the largest first, second and third difference of the executed commands over this step's
seams, in action units: a difference counts if its newest command is one of the blend's or of the three after it."""
HANDOVER_PEAK_JERK: Final = "handover/peak_jerk"
"""float64: the largest difference of neighbouring executed commands over the control interval, of any component, seam
or not, in action units per second."""
HANDOVER_BLEND_TIME: Final = "handover/blend_time"
"""float64: s, how long the longest blend takes that began in this step; 0 where none did."""
HANDOVER_STARVED: Final = "handover/starved"
"""int64: control steps of this step at which the queue was dry and the fallback gave the command."""
HANDOVER_LIMITED: Final = "handover/limited"
"""int64: control steps of this step at which a command was held back, beyond the blend, to keep `rate_limit`."""
HANDOVER_REFUSED: Final = "handover/refused"
"""bool: a chunk was refused: not finite, not newer than the one in force, too late, or out of reach."""
HANDOVER_LATENCY: Final = "handover/latency"
"""int64: control steps that went by between the observation and the takeover of the last chunk that took over in
this step, as consumed; -1 where none did."""
HANDOVER_STEPS: Final = "handover/steps"
"""int64: control steps executed in this step (fewer than the execution horizon where the episode ended)."""

# LeaseExpiry, every control step ---------------------------------------------------------------------------------
LEASE_REMAINING_S: Final = "lease/remaining_s"
"""float64: s that the lease in force has left after this control step; 0 where there is none."""
LEASE_EXPIRED: Final = "lease/expired"
"""bool: a lease ran out at this control step (once per lease)."""
LEASE_REFUSED: Final = "lease/refused"
"""bool: a command was refused: a fresh one was not granted a lease, or it was not finite, older than the one in
force or from the future, or a chunk's end was out of reach."""
LEASE_BRAKING: Final = "lease/braking"
"""bool: the fallback acted at this control step."""

# TeleopChannel, every control step --------------------------------------------------------------------------------
TELEOP_ROUND_TRIP_S: Final = "teleop/round_trip_s"
"""float64: s, age of the image that the command in force was made from; before the first one, since the reset."""
TELEOP_CEILING_S: Final = "teleop/ceiling_s"
"""float64: s, the longest admissible round trip when this step was decided on, within its `longest_s` of 0; inf
without a ceiling."""
TELEOP_CLEARANCE_M: Final = "teleop/clearance_m"
"""float64: m, the smaller clearance, before or after the step; inf without a ceiling, or with nothing near."""
TELEOP_REVOKED: Final = "teleop/revoked"
"""bool: the operator had no authority, the local brake acted."""
TELEOP_ENERGY_IN_J: Final = "teleop/energy_in_j"
"""float64: J, net energy that went into the channel at the operator's port so far; 0 without a port."""
TELEOP_ENERGY_OUT_J: Final = "teleop/energy_out_j"
"""float64: J, net energy that came out at the machine's port so far; 0 without a port."""
TELEOP_IN_FLIGHT_J: Final = "teleop/in_flight_j"
"""float64: J, energy of the waves on their way; 0 with plain coding."""
TELEOP_CREATED_J: Final = "teleop/created_j"
"""float64: J, the most that came out, or was in flight, beyond what went in, at any time so far; 0: passive."""
TELEOP_LOST: Final = "teleop/lost"
"""int64: packets of this step, in both directions, that got lost; an action that is not finite, which is not sent, is
one."""
TELEOP_LATE: Final = "teleop/late"
"""int64: commands that arrived in this step behind or together with a newer one."""

# ContactMonitor, every step: of the watched contacts over the physics substeps of the control step -----------------
CONTACT_PEAK_FORCE: Final = "contact/peak_force"
"""float64: N, the largest normal force between two bodies, summed over their contacts."""
CONTACT_IMPULSE: Final = "contact/impulse"
"""float64: N s, the normal forces of all contacts, summed and integrated over the control step."""
CONTACT_PENETRATION: Final = "contact/penetration"
"""float64: m, the deepest."""
CONTACT_RESIDUAL: Final = "contact/residual"
"""float64: N m, the largest ``|gap * force|`` of a contact: what misses complementarity."""
CONTACT_PARTIAL: Final = "contact/partial"
"""bool: not every substep was seen; the others are of the contacts that the step left behind, for one substep."""

# BalanceMonitor, every step: of the robot and its contacts with the fixed world ------------------------------------
BALANCE_LINEAR_MOMENTUM: Final = "balance/linear_momentum"
"""float64 array (3,): kg m/s, after the step."""
BALANCE_ANGULAR_MOMENTUM: Final = "balance/angular_momentum"
"""float64 array (3,): kg m^2/s about the centre of mass, after the step."""
BALANCE_FRICTION_USED: Final = "balance/friction_used"
"""float64: the largest ``|f_t| / (share mu f_n)`` of a contact that carries 1 % of the weight or more, over all
evaluations of the physics."""
BALANCE_ZMP_MARGIN: Final = "balance/zmp_margin"
"""float64: m, least distance of the zero moment point from the edge of the support polygon minus the inset, over the
evaluations with a polygon; 0 where there is none."""
BALANCE_SUPPORTED: Final = "balance/supported"
"""float64: share of the evaluations with a polygon: three contact points of one plane, not on a line."""
BALANCE_AIRBORNE: Final = "balance/airborne"
"""float64: share of the evaluations without a contact point."""
BALANCE_PARTIAL: Final = "balance/partial"
"""bool: not every evaluation was seen, and the others are of the contacts that the step left behind; or numbers were
not finite, and are reported as 0."""

# OcclusionPenalty, every step: one entry per track, after the step ------------------------------------------------
OCCLUSION_VISIBLE: Final = "occlusion/visible"
"""bool array, one per track: it was measured at the end of this step (in sight, in range, and not dropped out)."""
OCCLUSION_SIGMA: Final = "occlusion/sigma"
"""float64 array, one per track: m, standard deviation of the estimated position where it is largest."""
OCCLUSION_EXPIRED: Final = "occlusion/expired"
"""bool array, one per track: `sigmas` standard deviations would cross the tolerance before the next step ends,
if nothing is seen until then: no permission to rely on this track."""
OCCLUSION_PENALTY: Final = "occlusion/penalty"
"""float64: what was taken off this step's reward, in reward units."""
OCCLUSION_TASK_REWARD: Final = "occlusion/task_reward"
"""float64: the task's own reward of this step, before the penalty."""

# The faults of safe_wrappers.wrappers.faults, every step --------------------------------------------------------
FAULT_ACTIVE: Final = "fault/active"
"""bool: what the policy gave at this step did not arrive as it was: it was lost, late, or replaced."""
