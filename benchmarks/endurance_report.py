"""What the chunks of `benchmarks.endurance` say together: violations, margins, memory and speed."""

from dataclasses import asdict
from typing import Any

import numpy as np

from benchmarks.trained_adversary import FLAGS, Tally


def collected(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Sums per env and driver, and what memory and speed did over the steps of each process."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["env"], row["driver"]), []).append(row)
    envs = list(dict.fromkeys(row["env"] for row in rows))
    ordered = sorted(groups, key=lambda pair: envs.index(pair[0]))  # drivers as they came
    return {
        "drivers": [_pooled(groups[pair]) for pair in ordered],
        "memory": [m for m in map(memory, _processes(rows)) if m],
        "speed": speed(rows),
        "versions": sorted({row["versions"] for row in rows}),
    }


def _pooled(rows: list[dict[str, Any]]) -> dict[str, Any]:
    tally, off, timed = Tally(), Tally(), []
    extra = dict.fromkeys(("simulated", "simulated_violations"), 0)
    for row in rows:
        part = Tally(**{name: row[name] for name in Tally.__dataclass_fields__})
        if not row["filtered"]:
            off = off.plus(part)
            continue
        tally = tally.plus(part)
        off = off.plus(Tally(row.get("off_steps", 0), row.get("off_violations", 0)))
        for name in extra:
            extra[name] += row.get(name, 0)
        timed += [row["us"]] if "us" in row else []
    extra |= {"off_steps": off.steps, "off_violations": off.violations}
    us = float(np.median(timed)) if timed else None
    return {"env": rows[0]["env"], "driver": rows[0]["driver"], **asdict(tally), **extra, "us": us}


def _processes(rows: list[dict[str, Any]]) -> list[list[dict[str, Any]]]:
    found: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        found.setdefault(row["process"], []).append(row)
    return list(found.values())


def _warm(rows: list[dict[str, Any]]) -> list[tuple[int, dict[str, Any]]]:
    """The chunks of a process whose kind it has made before, with the filtered steps that it had made by then."""
    seen, found, steps = set(), [], 0
    for row in rows:
        steps += row["steps"] * row["filtered"]
        kind = row["env"], row["driver"], row["filtered"]
        if kind in seen:
            found.append((steps, row))
        seen.add(kind)
    return found


def memory(rows: list[dict[str, Any]]) -> dict[str, Any] | None:
    """What the memory of one process did after its first round, from a line through the ends of its chunks."""
    warm = _warm(rows)
    if len(warm) < 3:
        return None
    steps, mb = np.array([at for at, _ in warm], float), np.array([row["mb"] for _, row in warm])
    slope = float(np.polyfit(steps, mb, 1)[0])
    span = steps[-1] - steps[0]
    return {
        "chunks": len(warm),
        "steps": int(span),
        "least_mb": float(mb.min()),
        "most_mb": float(mb.max()),
        "growth": slope * span / float(mb.mean()),
    }


def speed(rows: list[dict[str, Any]]) -> dict[str, Any] | None:
    """Time per step in reference steps: its change per 1,000,000 steps, from a line with a height for each kind."""
    at: list[float] = []
    times: list[float] = []
    kinds: dict[tuple[Any, ...], list[int]] = {}
    for warm in map(_warm, _processes(rows)):
        for steps, row in warm:
            if "ratio" in row and not row["simulated"]:
                kind = row["process"], row["env"], row["driver"], row["filtered"]
                kinds.setdefault(kind, []).append(len(at))
                at.append(steps / 1e6)
                times.append(float(np.log(row["ratio"])))
    x, y = np.array(at), np.array(times)
    for members in kinds.values():
        x[members] -= x[members].mean()
        y[members] -= y[members].mean()
    free = len(x) - len(kinds) - 1
    if free < 1 or not x.any():
        return None
    slope = float(x @ y / (x @ x))
    error = float(np.sqrt(((y - slope * x) ** 2).sum() / free / (x @ x)))
    return {"chunks": len(x), "per_million": slope, "error": error}


def table(found: dict[str, Any]) -> str:
    """Markdown: a line per env and driver, one per env, and what memory and speed did."""
    lines = [
        "| env | driver | steps | violations | without the filter, of 1,000 | changed | infeasible | fallback "
        "| unsafe | lowest h (mm) | us a step | simulated steps |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    rows = [row for row in found["drivers"] if row["steps"]]
    for r in rows:
        off = f"{1e3 * r['off_violations'] / r['off_steps']:.0f}" if r["off_steps"] else "-"
        flags = " | ".join(f"{r[name]:,}" for name in FLAGS[1:])
        lines.append(
            f"| {r['env']} | {r['driver']} | {r['steps']:,} | {r['violations']:,} | {off} "
            f"| {r['intervened'] / r['steps']:.1%} | {flags} | {1e3 * r['smallest']:.3f} "
            f"| {'-' if r['us'] is None else format(r['us'], '.0f')} | {r['simulated'] or '-'} |"
        )
    lines += ["", "| env | steps | violations | at most, at 95 % | lowest h (mm) |", "|---|---|---|---|---|"]
    for env in [*dict.fromkeys(r["env"] for r in rows), ""]:
        part = [r for r in rows if env in ("", r["env"])]
        steps, bad = (sum(r[name] for r in part) for name in ("steps", "violations"))
        if steps:
            bound = f"{3.0 / steps:.1e} a step" if not bad else "-"
            least = 1e3 * min(r["smallest"] for r in part)
            lines.append(f"| {env or 'all'} | {steps:,} | {bad:,} | {bound} | {least:.3f} |")
    simulated, bad = (sum(r[name] for r in rows) for name in ("simulated", "simulated_violations"))
    lines += ["", f"Of {simulated:,} steps that searches simulated, {bad:,} were in violation.", ""]
    for m in found["memory"]:
        lines.append(
            f"Memory of a process after its first round, over {m['steps']:,} steps in {m['chunks']} chunks: "
            f"{m['least_mb']:.0f} to {m['most_mb']:.0f} MB; a line through them grows by {m['growth']:.2%}."
        )
    s = found["speed"]
    if s:
        lines.append(
            f"Time per step beside the reference, {s['chunks']} chunks: {s['per_million']:+.2%} per 1,000,000 steps "
            f"(standard error {s['error']:.2%})."
        )
    return "\n".join([*lines, "", *found["versions"]])
