"""One projection beside qpsolvers' backends on the same problems, and batches beside single calls, in one run.

python -m benchmarks.projection
"""

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import qpsolvers

from benchmarks.timing import paired_us
from safe_wrappers import project, project_batch

SIZES = ((2, 1), (2, 8), (6, 12), (17, 40))
"""Controls and rows: a point robot, several discs, a runner, a humanoid."""

BATCHES = (16, 256)
"""Problems at once: as many as a vector env has envs."""


def problems(m: int, k: int, count: int = 200) -> list[tuple[np.ndarray, ...]]:
    """Feasible problems whose nominal violates some row."""
    rng = np.random.default_rng(0)
    found = []
    while len(found) < count:
        inside = rng.uniform(-0.5, 0.5, m)
        normals = rng.normal(size=(k, m))
        offsets = normals @ inside + rng.uniform(0.01, 0.5, k)
        nominal = rng.uniform(-1.0, 1.0, m)
        if (normals @ nominal > offsets).any():
            found.append((nominal, normals, offsets, -np.ones(m), np.ones(m)))
    return found


def half_inactive(m: int, k: int, count: int) -> list[tuple[np.ndarray, ...]]:
    """Problems of which every second one has a nominal that keeps every row."""
    found = problems(m, k, count)
    return [(u, a, np.maximum(b, a @ u) if i % 2 else b, lo, hi) for i, (u, a, b, lo, hi) in enumerate(found)]


def cycling(call: Callable[..., Any], items: list[tuple[np.ndarray, ...]]) -> Callable[[], Any]:
    """A callable that takes the next problem at every call."""
    state = {"i": 0}

    def step() -> Any:
        state["i"] = (state["i"] + 1) % len(items)
        return call(*items[state["i"]])

    return step


def by_qpsolvers(solver: str) -> Callable[..., Any]:
    """The same projection written for qpsolvers."""

    def solve(u: np.ndarray, a: np.ndarray, b: np.ndarray, lo: np.ndarray, hi: np.ndarray) -> Any:
        return qpsolvers.solve_qp(np.eye(u.size), -u, a, b, lb=lo, ub=hi, solver=solver)

    return solve


def main() -> None:
    """Print the table."""
    warnings.simplefilter("ignore")
    print(
        "| controls x rows | project (us) | qpsolvers+daqp (us) | ratio | qpsolvers+clarabel (us) | ratio |"
    )
    print("|---|---|---|---|---|---|")
    for m, k in SIZES:
        items = problems(m, k)
        us = paired_us(
            {
                "ours": cycling(project, items),
                "daqp": cycling(by_qpsolvers("daqp"), items),
                "clarabel": cycling(by_qpsolvers("clarabel"), items),
            }
        )
        print(
            f"| {m} x {k} | {us['ours']:.1f} | {us['daqp']:.1f} | {us['daqp'] / us['ours']:.1f} "
            f"| {us['clarabel']:.0f} | {us['clarabel'] / us['ours']:.0f} |"
        )
    print()
    print("| batch of | controls x rows | single calls (us) | project_batch (us) | ratio |")
    print("|---|---|---|---|---|")
    for count in BATCHES:
        for m, k in SIZES:
            items = half_inactive(m, k, count)
            arrays = [np.stack(part) for part in zip(*items, strict=True)]
            us = paired_us(
                {
                    "single": lambda items=items: [project(*item) for item in items],
                    "batch": lambda arrays=arrays: project_batch(*arrays),
                },
                rounds=9,
                batch=5,
            )
            print(
                f"| {count} | {m} x {k} | {us['single']:.0f} | {us['batch']:.0f} "
                f"| {us['single'] / us['batch']:.1f} |"
            )


if __name__ == "__main__":
    main()
