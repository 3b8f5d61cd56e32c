"""A tool pressed against a wall through a late network: energy made, force, and clearance, by coding.

    python -m benchmarks teleop              # 5 seeds of everything: 40 minutes on one core; goes on where it stopped
    python -m benchmarks teleop --seeds 1    # a look

`TeleopContact-v0` behind a `TeleopChannel`, 6 s an episode at 1 kHz. The delay is that of *each* direction. Networks:
**steady** has nothing but the delay; **rough** has up to 30 % more, drawn for each packet, and 5 % of loss;
**outages** is rough, and loses all commands for 0.3 s every 2 s, on average. Operators (`TeleopOperator`): the
**careful** one stops before the clamp, as far as what he sees lets him; the other **looks away** and sweeps on.

Judged from outside the channel: energy is that of the operator's hand at the force that he is shown, and of what
acted on the tool by the env's own account; clearance is the env's, at every physics substep.
"""

import itertools
import math
from typing import Any, Final, NamedTuple

import gymnasium as gym
import numpy as np

import safe_wrappers as sw
from benchmarks.tables import CORES, RUNS, keep, markdown, measured, options, total
from safe_wrappers.envs.teleop_contact import TELEOP_ACCELERATION, TELEOP_BRAKING, TELEOP_TOP_SPEED
from safe_wrappers.envs.teleop_operator import TeleopOperator
from safe_wrappers.wrappers.faults import Outages

DELAYS_S = (0.0, 0.025, 0.05, 0.1, 0.2, 0.3)
"""Of each direction."""
JITTER, LOSS = 0.3, 0.05
"""Share of the delay; share of the packets."""
OUTAGE_BETWEEN_S, OUTAGE_LENGTH_S = 2.0, 0.3
CODINGS: Final[dict[str, dict[str, Any]]] = {
    "plain": {},
    "wave": {"impedance": 40.0},
}
NETWORKS = ("steady", "rough", "outages")
OPERATORS = ("careful", "looks away")


class Job(NamedTuple):
    """One combination, and one seed of env, network and operator."""

    coding: str
    network: str
    delay_s: float
    operator: str
    revocation: bool
    seed: int
    steps: int = 6000


def link(network: str, delay_s: float) -> sw.teleop.Link:
    """One direction."""
    return sw.teleop.Link(delay_s) if network == "steady" else sw.teleop.Link(delay_s, JITTER * delay_s, LOSS)


def reading(env: gym.Env[Any, Any]) -> tuple[list[float], list[float]]:
    """Clearance to the clamp and approach speed."""
    raw: Any = env.unwrapped
    return [raw.clearance], [float(raw.tool_velocity[1])]


def channel(job: Job) -> sw.TeleopChannel:
    """The env behind its channel."""
    machine = {"braking": TELEOP_BRAKING, "acceleration": TELEOP_ACCELERATION, "top_speed": TELEOP_TOP_SPEED}
    return sw.TeleopChannel(
        gym.make("TeleopContact-v0", max_episode_steps=job.steps, disable_env_checker=True),
        uplink=link(job.network, job.delay_s),
        downlink=link(job.network, job.delay_s),
        budget=sw.StoppingBudget(reading, **machine) if job.revocation else None,
        **CODINGS[job.coding],
    )


def run(job: Job) -> dict[str, Any]:
    """One episode."""
    env: gym.Env[Any, Any] = channel(job)
    if job.network == "outages":
        env = Outages(env, OUTAGE_BETWEEN_S, OUTAGE_LENGTH_S)
    raw: Any = env.unwrapped
    operator = TeleopOperator(job.seed, stops=job.operator == "careful")
    observation, _ = env.reset(seed=job.seed)
    effort = np.array(raw.port_effort_observed)
    net = lowest = peak = 0.0
    least, breached, revoked = math.inf, 0, 0
    for _ in range(job.steps):
        action = operator.act(observation)
        observation, _, _, _, info = env.step(action)
        net += float(observation[effort] @ action) * raw.dt
        if not info["teleop/revoked"]:
            net -= float(raw.port_effort_acted @ info["executed_action"]) * raw.dt
        lowest, peak = min(lowest, net), max(peak, info["contact_force"])
        least = min(least, info["clearance"])
        breached += int(info["cost"] > 0.0)
        revoked += int(info["teleop/revoked"])
    found = {"made_j": max(-lowest, 0.0), "peak_n": peak, "swept_m": float(info["swept"])}
    return job._asdict() | found | {"breached": breached > 0, "least_m": least, "revoked_steps": revoked}


def _some(rows: list[dict[str, Any]], **wanted: Any) -> list[dict[str, Any]]:
    return [row for row in rows if all(row[key] == value for key, value in wanted.items())]


def energy_table(rows: list[dict[str, Any]]) -> str:
    """Markdown: careful operators without revocation; one line per network and delay, codings side by side."""
    lines = []
    careful = _some(rows, operator="careful", revocation=False)
    for network, delay in itertools.product(NETWORKS, DELAYS_S):
        parts = [_some(careful, coding=coding, network=network, delay_s=delay) for coding in CODINGS]
        figures = (
            [energy(float(np.mean([row["made_j"] for row in part]))) for part in parts],
            [f"{max(row['peak_n'] for row in part):.0f}" for part in parts],
            [f"{100.0 * float(np.mean([row['swept_m'] for row in part])):.0f}" for part in parts],
        )
        lines.append([network, f"{1e3 * delay:g}", *map(" / ".join, figures)])
    head = f"network | delay each way (ms) | energy made (J): {' / '.join(CODINGS)} | peak force (N)"
    return markdown(f"{head} | swept (cm)", lines)


def energy(joule: float) -> str:
    """0 below a microjoule."""
    return "0" if joule < 1e-6 else f"{joule:.2g}" if joule < 99.5 else f"{joule:.0f}"


def clearance_table(rows: list[dict[str, Any]]) -> str:
    """Markdown: episodes that touched the clamp, with revocation and without, all delays together."""
    lines = []
    for operator, network, coding in itertools.product(OPERATORS, NETWORKS, CODINGS):
        part = _some(rows, operator=operator, network=network, coding=coding)
        off, on = (_some(part, revocation=revocation) for revocation in (False, True))
        least = f"{1e3 * min(row['least_m'] for row in on):.2f}"
        share = f"{total(on, 'revoked_steps') / total(on, 'steps'):.1%}"
        counts = [len(on), total(off, "breached"), total(on, "breached")]
        lines.append([operator, network, coding, *counts, least, share])
    head = "operator | network | coding | episodes each | breached, no revocation | with revocation"
    return markdown(f"{head} | least clearance (mm) | time revoked", lines)


def main() -> None:
    """Run what is missing, print the tables."""
    given = options(__doc__, seeds=5, workers=CORES)
    kinds = itertools.product(range(given.seeds), NETWORKS, DELAYS_S, CODINGS, OPERATORS, (False, True))
    jobs = [
        Job(coding, net, delay, who, revocation, seed) for seed, net, delay, coding, who, revocation in kinds
    ]
    rows = measured(RUNS / "teleop/teleop.jsonl", jobs, run, given.workers)
    keep("teleop", f"{energy_table(rows)}\n\n{clearance_table(rows)}")
