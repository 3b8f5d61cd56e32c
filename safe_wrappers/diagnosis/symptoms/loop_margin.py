"""Sampling and latency: the phase that hold and delay take from the loop which a policy closes."""

import mujoco
import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.control.watchdog.sampling import phase_lag
from safe_wrappers.diagnosis.finding import Evidence
from safe_wrappers.diagnosis.recording import Env, Recording
from safe_wrappers.diagnosis.symptom import Measured, NotMeasuredError, Symptom, require_physics
from safe_wrappers.diagnosis.symptoms.late_commands import ages

LINEAR = 0.9
"""Share of the variance of a command that a linear function of the state must explain."""
_SATURATED = 0.98  # of the end of the range
_FREQUENCIES = 4000
_NUDGE = 1e-5
_UNSTABLE = 100.0


def _gains(recording: Recording, low: Array, high: Array) -> tuple[Array, Array]:
    """The policy as u = gains @ (state - mean) + constant: gains (m, n), and the mean state."""
    before = np.flatnonzero(~recording.first)
    before = before[before > 0]
    state = np.hstack([recording.qpos, recording.qvel])[before - 1]
    action = recording.actions[before]
    inner = (np.abs(action - (low + high) / 2.0) < _SATURATED * (high - low) / 2.0).all(axis=1)
    if inner.sum() < 2 * state.shape[1]:
        raise NotMeasuredError("the policy's actions are at the ends of their range: there is no linear loop")
    state, action = state[inner], action[inner]
    mean = state.mean(axis=0)
    gains, *_ = np.linalg.lstsq(
        np.hstack([state - mean, np.ones((len(state), 1))]), action, rcond=1e-8
    )  # the least gains where the data leave a choice
    left = action - (state - mean) @ gains[:-1] - gains[-1]
    if (left.var(axis=0) > (1.0 - LINEAR) * action.var(axis=0)).any():
        raise NotMeasuredError("the policy is not close to a linear function of position and velocity")
    return gains[:-1].T, mean


def _held_step(model: mujoco.MjModel, mean: Array, steps: int) -> tuple[Array, Array]:
    """The control step as x+ = A x + B u at a state, by differences; A (2 nv, 2 nv), B (2 nv, nu)."""
    data, n = mujoco.MjData(model), len(mean)

    def after(change: Array) -> Array:
        mujoco.mj_resetData(model, data)
        state = mean + change[:n]
        data.qpos[:], data.qvel[:], data.ctrl[:] = state[: model.nq], state[model.nq :], change[n:]
        mujoco.mj_step(model, data, steps)
        return np.concatenate([data.qpos, data.qvel])

    nudges = _NUDGE * np.eye(n + model.nu)
    slopes = np.array([(after(nudge) - after(-nudge)) / (2.0 * _NUDGE) for nudge in nudges]).T
    return slopes[:, :n], slopes[:, n:]


def loop(a: Array, b: Array, gains: Array, delay: int, broken: int, dt: float) -> tuple[float, float]:
    """Phase margin, rad, and crossover, rad/s, of x+ = a x + b u, u = gains x `delay` steps late, cut at one input.

    A loop without a crossover has an infinite margin; an unstable closed one has none, 0.
    """
    n, m = b.shape
    size = n + m * delay
    full, entry = np.zeros((size, size)), np.zeros((size, m))
    full[:n, :n] = a
    if delay:
        full[:n, n : n + m] = b
        full[n : size - m, n + m :] = np.eye(m * (delay - 1))
        entry[size - m :] = np.eye(m)
    else:
        entry[:n] = b
    feedback = np.hstack([gains, np.zeros((m, m * delay))])
    if np.abs(np.linalg.eigvals(full + entry @ feedback)).max() >= 1.0 + 1e-9:
        return 0.0, np.nan
    others = [i for i in range(m) if i != broken]
    opened = full + entry[:, others] @ feedback[others]
    grid = np.geomspace(1e-3, 1.0, _FREQUENCIES) * np.pi / dt
    response = np.array(
        [
            -feedback[broken] @ np.linalg.solve(np.exp(1j * w * dt) * np.eye(size) - opened, entry[:, broken])
            for w in grid
        ]
    )
    size_db = np.log(np.abs(response))
    at = np.flatnonzero(size_db[:-1] * size_db[1:] < 0.0)
    if not at.size:
        return np.inf, np.nan
    margins = np.abs(np.angle(-response[at]))
    worst = int(np.argmin(margins))
    return float(margins[worst]), float(grid[at[worst]])


def measure(env: Env, recording: Recording) -> Measured:
    """The phase that hold and delay take, as a multiple of what is left, in the worst actuator's loop."""
    (model, _), dt = require_physics(env, "that could be linearised"), recording.control_dt
    if model.nq != model.nv or model.na or recording.actions.shape[1] != model.nu:
        raise NotMeasuredError(
            "only machines of hinges and slides, whose actions are controls without activation, are linearised"
        )
    low, high = np.where(
        model.actuator_ctrllimited.astype(bool)[:, None], model.actuator_ctrlrange, [-1e9, 1e9]
    ).T
    if not recording.repeats:
        raise NotMeasuredError(
            "the policy gives other actions for the same observation: it is no feedback alone"
        )
    if not np.allclose(recording.controls, recording.executed, rtol=1e-5, atol=1e-6):
        raise NotMeasuredError("the env makes other controls of its actions")
    gains, mean = _gains(recording, low, high)
    age = ages(env, recording)
    delay = int(np.nanmedian(age))
    a, b = _held_step(model, mean, round(dt / model.opt.timestep))
    worst, evidence = 0.0, [Evidence("delay of commands", delay * dt, "s"), Evidence("hold", dt, "s")]
    for i in range(model.nu):
        margin, crossover = loop(a, b, gains, delay, i, dt)
        if np.isinf(margin):
            continue
        if margin == 0.0:
            if not recording.terminated.any():
                raise NotMeasuredError(
                    "linearised at its mean state the loop is unstable, which the machine is not"
                )
            evidence.append(Evidence("phase margin left", 0.0, "deg"))
            return Measured(_UNSTABLE, np.nan_to_num(age) * dt, evidence)
        lag = float(phase_lag(crossover, dt, delay * dt)) if crossover * dt < np.pi else np.pi
        taken = min(lag / margin, _UNSTABLE)
        if taken > worst:
            worst = taken
            name = model.actuator(i).name or f"actuator {i}"
            evidence = [
                *evidence[:2],
                Evidence(f"phase margin left, {name}", float(np.degrees(margin)), "deg"),
                Evidence("taken by hold and delay", float(np.degrees(lag)), "deg"),
                Evidence("crossover", crossover, "rad/s"),
            ]
    return Measured(worst, np.nan_to_num(age) * dt, evidence)


def lines(env: Env, recording: Recording) -> tuple[str, str]:
    """No wrapper gives phase back."""
    return "", (
        "No wrapper gives the phase back: shorten the delay or the control interval, or train with lower gains (a "
        "penalty on changes of the action). Tell filters of the delay: AnalyticPlant(delay_s=...)."
    )


SYMPTOM = Symptom(
    "sampling and latency that use up the loop's phase margin", "section 1.3.5, zero-order hold and delay",
    1.0, "times what is left", ("age of commands", "s"), measure, lines, policies_only=True,
)  # fmt: skip
