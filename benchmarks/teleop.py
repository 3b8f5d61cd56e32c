"""A tool pressed against a wall through a late network: energy made, chatter, force, and clearance, by coding.

    python -m benchmarks.teleop              # 5 seeds of everything: an hour on one core; goes on where it stopped
    python -m benchmarks.teleop --seeds 1    # a look

`TeleopContact-v0` behind a `TeleopChannel`, 6 s an episode at 1 kHz. The delay is that of *each* direction, so the
round trip is twice that. Networks: **steady** has nothing but the delay; **rough** has up to 30 % more, drawn for
each packet, 5 % of loss, and packets that overtake each other; **outages** is rough and goes silent for 0.3 s every
2 s, on average. Operators (`TeleopOperator`): the **careful** one stops before the clamp, as far as what he sees lets
him; the other **looks away** and sweeps on. Both have a reaction time of their own, from 0.15 to 0.25 s, and an arm
that gives way. **Corners** is no human: it holds +-1 m/s against any force and switches at random.

Judged from outside the channel. Energy: of the operator's hand at the force that he is shown, and of what acted on
the tool by the env's own account; the channel's word is taken for what is in flight only. Chatter: how often per
second the tool touches the wall anew after the first time, and the standard deviation of the wall's force from 1.5 s
after the first touch. Clearance: the env's, at every physics substep.

The hand of the scripted operator answers a force one tick after it was shown. `made_at_hand_j` counts energy with
that force instead: what sampling at the operator's end adds, which no channel sees.

Extractable energy: what comes out of both ports together between any two ticks, less what goes in, may not be above
what was in flight at the first of them. The excess over that is computed for every pair of ticks.
"""

import argparse
import math
import multiprocessing
from dataclasses import asdict, dataclass
from typing import Any, Final

import gymnasium as gym
import numpy as np

import safe_wrappers as sw
from benchmarks import chunks
from benchmarks.tables import RESULTS, markdown, total
from safe_wrappers.checks import Array
from safe_wrappers.envs.teleop_contact import TELEOP_ACCELERATION, TELEOP_BRAKING, TELEOP_TOP_SPEED
from safe_wrappers.envs.teleop_operator import TeleopOperator

DELAYS_S = (0.0, 0.025, 0.05, 0.1, 0.2, 0.3)
"""Of each direction."""
JITTER = 0.3
"""Of the delay."""
LOSS = 0.05
OUTAGE_BETWEEN_S, OUTAGE_LENGTH_S = 2.0, 0.3
SETTLED_S = 1.5
"""After the first touch the force is ramped up until then."""
CODINGS: Final[dict[str, dict[str, Any]]] = {
    "plain": {"coding": "plain"},
    "wave": {"coding": "wave", "impedance": 40.0},
}
NETWORKS = ("steady", "rough", "outages")
OPERATORS = ("careful", "looks away", "corners")
CORNERS_DELAYS_S = (0.0, 0.05, 0.2)
CORNERS_HOLD = (20, 200)
"""Ticks between two switches, from and below."""


@dataclass(frozen=True)
class Job:
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
    if network == "steady":
        return sw.teleop.Link(delay_s)
    silent = (OUTAGE_BETWEEN_S, OUTAGE_LENGTH_S) if network == "outages" else (None, None)
    return sw.teleop.Link(delay_s, JITTER * delay_s, LOSS, False, *silent)


def reading(env: gym.Env[Any, Any]) -> tuple[list[float], list[float]]:
    """Clearance to the clamp and approach speed."""
    raw: Any = env.unwrapped
    return [raw.clearance], [float(raw.tool_velocity[1])]


def channel(job: Job) -> sw.TeleopChannel:
    """The env behind its channel."""
    ceiling = sw.teleop.RoundTripCeiling(
        sw.StoppingBudget(
            reading, braking=TELEOP_BRAKING, acceleration=TELEOP_ACCELERATION, top_speed=TELEOP_TOP_SPEED
        )
    )
    return sw.TeleopChannel(
        gym.make("TeleopContact-v0", max_episode_steps=job.steps, disable_env_checker=True),
        uplink=link(job.network, job.delay_s),
        downlink=link(job.network, job.delay_s),
        ceiling=ceiling if job.revocation else None,
        **CODINGS[job.coding],
    )


class Corners:
    """Holds a corner of the action space for a random time, then another; no force moves it."""

    def __init__(self, seed: int) -> None:
        self._random = np.random.default_rng(seed)
        self._left = 0

    def act(self, observation: Array) -> Array:
        """Shape (2,), m/s."""
        if self._left == 0:
            self._left = int(self._random.integers(*CORNERS_HOLD))
            self._corner = self._random.choice([-1.0, 1.0], size=2)
        self._left -= 1
        return np.array(self._corner)


def operator_of(job: Job) -> TeleopOperator | Corners:
    """Who steers."""
    if job.operator == "corners":
        return Corners(job.seed)
    return TeleopOperator(job.seed, stops=job.operator == "careful")


def excess(net_j: Array, in_flight_j: Array) -> float:
    """By how much more came out after any tick than was in flight at it, at most, J.

    Args:
        net_j: Energy that went in less what came out, at the end of each tick, shape (n,).
        in_flight_j: At the end of each tick, shape (n,).
    """
    net, flying = np.concatenate([[0.0], net_j]), np.concatenate([[0.0], in_flight_j])
    lowest_from_here = np.minimum.accumulate(net[::-1])[::-1]
    return float(np.max(net - flying - lowest_from_here))


def chatter(force: Array, step_s: float) -> dict[str, float | None]:
    """Of the wall's force over an episode, shape (n,), N: None where there was no time to see it."""
    touching = force > 0.0
    first = int(np.argmax(touching)) if touching.any() else force.size
    since_s = (force.size - first) * step_s
    again = int((~touching[first:-1] & touching[first + 1 :]).sum()) if first < force.size else 0
    settled = force[first + round(SETTLED_S / step_s) :]
    return {
        "contacts_per_s": again / since_s if since_s > 0.5 else None,
        "ripple_n": float(settled.std()) if settled.size * step_s > 0.5 else None,
        "peak_n": float(force.max()),
    }


def run(job: Job) -> dict[str, Any]:
    """One episode."""
    env = channel(job)
    raw: Any = env.unwrapped
    operator = operator_of(job)
    observation, _ = env.reset(seed=job.seed)
    effort = np.array(env.port.effort)  # type: ignore[union-attr]
    net, flying, force = (np.zeros(job.steps) for _ in range(3))
    total, late, at_hand = 0.0, 0.0, 0.0
    least, breached, revoked, created = math.inf, 0, 0, 0.0
    for n in range(job.steps):
        action, shown = operator.act(observation), observation
        observation, _, _, _, info = env.step(action)
        felt = observation[effort]
        total += float(felt @ action) * raw.dt
        late += float((shown[effort] - felt) @ action) * raw.dt
        if not info["teleop/revoked"]:
            total -= float(raw.port_effort_acted @ info["executed_action"]) * raw.dt
        net[n], flying[n], force[n] = total, info["teleop/in_flight_j"], info["contact_force"]
        at_hand = min(at_hand, total + late)
        least = min(least, info["clearance"])
        breached += int(info["cost"] > 0.0)
        revoked += int(info["teleop/revoked"])
        created = info["teleop/created_j"]
    return {
        **asdict(job),
        "excess_j": excess(net, flying),
        "made_j": max(-float(net.min()), 0.0),
        "made_at_hand_j": max(-at_hand, 0.0),
        "created_j": created,
        "flying_j": float(flying.max()),
        "breached_steps": breached,
        "least_m": least,
        "revoked_steps": revoked,
        "swept_m": info["swept"],
        **chatter(force, raw.dt),
    }


# Tables ------------------------------------------------------------------------------------------------------


def _some(rows: list[dict[str, Any]], **wanted: Any) -> list[dict[str, Any]]:
    return [r for r in rows if all(r[k] == v for k, v in wanted.items())]


def _mean(rows: list[dict[str, Any]], key: str, form: str) -> str:
    known = [r[key] for r in rows if r[key] is not None]
    return format(float(np.mean(known)), form) if known else "-"


def energy_table(rows: list[dict[str, Any]], codings: tuple[str, ...], networks: tuple[str, ...]) -> str:
    """Markdown: careful operators without revocation; one line per network and delay, codings side by side."""
    names = " / ".join(codings)
    lines = []
    for network in networks:
        for delay in DELAYS_S:
            parts = [
                _some(rows, coding=c, network=network, delay_s=delay, operator="careful", revocation=False)
                for c in codings
            ]
            if not all(parts):
                continue
            figures = (
                [energy(float(np.mean([r["made_j"] for r in p]))) for p in parts],
                [_mean(p, "contacts_per_s", ".1f") for p in parts],
                [_mean(p, "ripple_n", ".2f") for p in parts],
                [f"{max(r['peak_n'] for r in p):.0f}" for p in parts],
                [f"{100.0 * float(np.mean([r['swept_m'] for r in p])):.0f}" for p in parts],
            )
            lines.append([network, f"{1e3 * delay:g}", *map(" / ".join, figures)])
    head = f"network | delay each way (ms) | energy made (J): {names} | touches per s | force ripple (N)"
    return markdown(f"{head} | peak force (N) | swept (cm)", lines)


def energy(joule: float) -> str:
    """0 below a microjoule."""
    return "0" if joule < 1e-6 else f"{joule:.2g}" if joule < 99.5 else f"{joule:.0f}"


def clearance_table(rows: list[dict[str, Any]]) -> str:
    """Markdown: episodes that touched the clamp, with revocation and without, all delays together."""
    lines = []
    for operator in OPERATORS:
        for network in NETWORKS:
            for coding in CODINGS:
                off, on = (
                    _some(rows, operator=operator, network=network, coding=coding, revocation=r)
                    for r in (False, True)
                )
                if not on:
                    continue
                breached = [
                    str(sum(r["breached_steps"] > 0 for r in part)) if part else "-" for part in (off, on)
                ]
                share = total(on, "revoked_steps") / total(on, "steps")
                least = f"{1e3 * min(r['least_m'] for r in on):.2f}"
                lines.append([operator, network, coding, len(on), *breached, least, f"{share:.1%}"])
    head = "operator | network | coding | episodes each | breached, no revocation | with revocation"
    return markdown(f"{head} | least clearance (mm) | time revoked", lines)


def both_table(rows: list[dict[str, Any]]) -> str:
    """Markdown: both invariants in the same runs, of waves with revocation."""
    lines = []
    for operators in (OPERATORS[:2], OPERATORS[2:]):
        waves = _some(rows, coding="wave", revocation=True)
        part = [r for r in waves if r["operator"] in operators]
        if part:
            excess_j, flying_j, at_hand_j = (
                max(r[key] for r in part) for key in ("excess_j", "flying_j", "made_at_hand_j")
            )
            cells = [", ".join(operators), len(part), f"{total(part, 'steps'):,}", f"{excess_j:.1e}"]
            breaches = sum(r["breached_steps"] > 0 for r in part)
            lines.append([*cells, energy(flying_j), f"{at_hand_j:.1e}", breaches])
    head = "operators | episodes | ticks | extracted beyond what was in flight, at most (J)"
    return markdown(f"{head} | most in flight (J) | made, with the hand a tick late (J) | breaches", lines)


def tables(rows: list[dict[str, Any]]) -> str:
    """All of them."""
    return "\n\n".join(
        [
            energy_table(rows, tuple(CODINGS), NETWORKS),
            clearance_table(rows),
            both_table(rows),
        ]
    )


def jobs(seeds: int) -> list[Job]:
    """Seed by seed, so that every look is at all of it."""
    return [
        Job(coding, network, delay, operator, revocation, seed)
        for seed in range(seeds)
        for network in NETWORKS
        for delay in DELAYS_S
        for coding in CODINGS
        for operator in OPERATORS
        for revocation in (False, True)
        if operator != "corners" or delay in CORNERS_DELAYS_S
    ]


def main() -> None:
    """Run what is missing, keep every episode, print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--workers", type=int, default=multiprocessing.cpu_count())
    arguments = parser.parse_args()
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / "teleop.jsonl"
    known = chunks.known(path, Job)
    rows = chunks.measured(path, jobs(arguments.seeds), run, arguments.workers, known)
    text = tables(list(rows.values()))
    (RESULTS / "teleop.md").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
