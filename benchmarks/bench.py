"""What the filter costs, in one table: beside bare envs, other packages, and the version before.

    python -m benchmarks bench                           # about six minutes; writes results/bench.json
    python -m benchmarks bench --only Reacher project    # rows whose name holds one of these words

A row divides the time of ours by that of what it is compared with, where the filter changes nothing (inactive) and
where it does (active); 1.0 is no cost. Both sides run in turn in one process. Infeasible: share of the active
driver's steps; correction: mean length of its changes, in units of the action. Before: how this run's ratios compare
with those of the committed results, inactive and active; below 1 is faster.
"""

import json
import math
import subprocess
import warnings
from collections.abc import Iterator
from typing import Any

import safe_wrappers as sw
from benchmarks import env_step, peers
from benchmarks.tables import RESULTS, options

RESULT = RESULTS / "bench.json"
HEAD = """| what | over | inactive (us) | active (us) | inactive | active | infeasible | correction | before |
|---|---|---|---|---|---|---|---|---|"""
Row = dict[str, Any]


def row(inactive: tuple[float, float], active: tuple[float, float], **more: float) -> Row:
    """The figures of a row, of microseconds and ratios."""
    us = {"inactive_us": inactive[0], "active_us": active[0]}
    return us | {"inactive": inactive[1], "active": active[1]} | more


def env_row(name: str, steps: int) -> Row:
    """A filtered env over the bare one."""
    driver, protect = env_step.ACTIVE[name]
    quiet, _ = env_step.measure(name, env_step.gentle, sw.protect, active=False, steps=steps)
    pushed, more = env_step.measure(name, driver, protect, active=True, steps=steps)
    return row(quiet, pushed, **more)


def peer_rows(inactive: peers.Times, active: peers.Times) -> dict[str, Row]:
    """Ours over each of the others."""
    ours, *others = active
    return {
        other: row(*((times[ours], times[ours] / times[other]) for times in (inactive, active)))
        for other in others
    }


def measured(wanted: list[str], steps: int) -> Iterator[tuple[str, str, Row]]:
    """What, over what, and the figures, for rows whose name holds one of the words."""

    def asked(what: str) -> bool:
        return not wanted or any(word in what for word in wanted)

    for name in filter(asked, env_step.ACTIVE):
        yield name, "the env", env_row(name, steps)
    if asked("SafePointGoal1-v0, 64 envs"):
        drivers = env_step.gentle, env_step.SEEKING  # the second has a third of its steps changed
        sides = (env_step.measure_vector(64, driver) for driver in drivers)
        yield "SafePointGoal1-v0, 64 envs", "the vector env", row(*sides)
    calls = {f"project, {m} x {k}": (peers.projections, (m, k)) for m, k in peers.SIZES}
    calls["double integrator"] = (peers.filter_calls, ())  # type: ignore[assignment]
    for what in filter(asked, calls):
        measure, size = calls[what]
        for other, found in peer_rows(measure(*size, active=False), measure(*size, active=True)).items():
            yield what, other, found


def committed() -> dict[str, Row]:
    """The results of the last commit, none outside of a repository."""
    path = f"HEAD:./{RESULT.name}"
    said = subprocess.run(["git", "show", path], cwd=RESULT.parent, capture_output=True, text=True)
    rows: dict[str, Row] = json.loads(said.stdout) if said.returncode == 0 else {}
    return rows


def line(what: str, over: str, row: Row, old: Row | None) -> str:
    """One line of the table."""
    rare = [
        f"{row[key]:{form}}" if key in row else ""
        for key, form in (("infeasible", ".1%"), ("correction", ".2g"))
    ]
    before = "" if old is None else " / ".join(f"{row[key] / old[key]:.2f}" for key in ("inactive", "active"))
    us = (
        f"{row[key]:.3g}" if row[key] < 100.0 else f"{row[key]:.0f}" for key in ("inactive_us", "active_us")
    )
    ratios = (f"{row[key]:.2f}" if row[key] >= 0.1 else f"{row[key]:.1g}" for key in ("inactive", "active"))
    return f"| {' | '.join([what, over, *us, *ratios, *rare, before])} |"


def main() -> None:
    """Measure, print, and write the results if every row was asked for."""
    given = options(__doc__, only=[], steps=1500)
    warnings.simplefilter("ignore")
    old, rows = committed(), {}
    print(HEAD)
    for what, over, row in measured(given.only, given.steps):
        key = f"{what} over {over}"
        rows[key] = {
            name: None if math.isnan(value) else float(f"{value:.4g}") for name, value in row.items()
        }
        print(line(what, over, row, old.get(key)), flush=True)
    if not given.only:
        RESULT.write_text(json.dumps(rows, indent=1) + "\n")
