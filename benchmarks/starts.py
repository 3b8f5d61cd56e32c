"""How often an env that `protect` knows starts an episode outside the safe set.

    python -m benchmarks.starts                   # 1,000 resets of every env
    python -m benchmarks.starts --envs Reacher    # of the envs whose id has one of these words

A start is unsafe if the filter says so (`cbf/unsafe` of the reset), or the env's own truth (`benchmarks/judges.py`).
h is 0 where there is nothing to measure from: no hazards, wheels at rest.
"""

import argparse
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.cases import PROTECTED, Case
from benchmarks.tables import RESULTS, keep, markdown
from safe_wrappers.errors import UnsafeStateWarning


def measure(case: Case, resets: int, seed: int = 0) -> dict[str, Any]:
    """Reset so often, with as many seeds, and count."""
    warnings.simplefilter("ignore", UnsafeStateWarning)  # counted
    env = case.protect(case.make())
    judge = case.judge(env.unwrapped)
    unsafe = violated = 0
    smallest = np.inf
    for at in range(seed, seed + resets):
        _, info = env.reset(seed=at)
        unsafe += int(info["cbf/unsafe"])
        smallest = min(smallest, info["cbf/margin"])
        violated += int(not judge.start() <= 0.0)
    env.close()
    row = {"env": case.env_id, "also": list(case.also), "resets": resets}
    return row | {"unsafe": unsafe, "violated": violated, "smallest": smallest}


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown: one line per env."""
    counts = ("resets", "unsafe", "violated")
    return markdown(
        "env | resets | unsafe by the filter | by the env's truth | smallest h",
        (
            [", ".join((r["env"], *r["also"])), *(f"{r[key]:,}" for key in counts), f"{r['smallest']:.3g}"]
            for r in rows
        ),
    )


def main() -> None:
    """Measure, print the table, keep the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--resets", type=int, default=1_000, help="per env")
    parser.add_argument("--envs", nargs="+", help="words; an env whose name has one of them is measured")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder for the rows and the table")
    arguments = parser.parse_args()
    chosen = [c for n, c in PROTECTED.items() if not arguments.envs or any(w in n for w in arguments.envs)]
    if not chosen:
        parser.error(f"nothing to measure; the envs are: {', '.join(PROTECTED)}")
    rows = [measure(case, arguments.resets) for case in chosen]
    keep(arguments.results, "starts", rows, table(rows))


if __name__ == "__main__":
    main()
