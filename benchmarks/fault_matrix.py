"""Every exported wrapper and every constraint under every fault: what becomes of it.

    python -m benchmarks.fault_matrix                       # all rows that are not in the CSV yet
    python -m benchmarks.fault_matrix --only LeaseExpiry    # one row anew

A cell is a short episode on a real env, with a recorder at its bottom that sees every action which reaches the
simulation, and the fault in the middle. After it the next episode has to be bit for bit that of an env that never saw
the fault. Cells go to `benchmarks/results/fault_matrix.csv`, the table to `fault_matrix.md`.
"""

import argparse
import csv
import sys
import warnings
from collections.abc import Collection
from pathlib import Path

from benchmarks.faults.decisions import decisions
from benchmarks.faults.episodes import plain
from benchmarks.faults.inputs import inputs
from benchmarks.faults.lifecycle import lifecycle
from benchmarks.faults.machine import machine
from benchmarks.faults.outcomes import DEFECTS, Cell, Found, Outcome
from benchmarks.faults.stacks import Row, rows
from benchmarks.faults.table import markdown

RESULTS = Path(__file__).parent / "results" / "fault_matrix.csv"
COLUMNS = ("kind", "row", "example", "fault", "variant", "outcome", "note")
GROUPS = {"The action": inputs, "The decision": decisions, "The machine": machine, "The env": lifecycle}


def cells(row: Row, groups: tuple[str, ...] = tuple(GROUPS)) -> dict[tuple[str, str], Cell]:
    """The cells of a row, by fault and variant."""
    return {key: cell for group in groups for key, cell in GROUPS[group](row).items()}


def outcome(row: Row, cell: Cell, clean: object) -> Found:
    """Of one cell; `clean` is the episode of an env that never saw a fault."""
    session = row.open()
    try:
        found = cell(session)
        if found.outcome in DEFECTS or found.outcome is Outcome.NOT_APPLICABLE:
            return found
        if plain(session.episode()) == clean:
            return found
    except Exception as error:
        return Found(Outcome.CRASHED, f"{type(error).__name__}: {error}")
    return Found(Outcome.DIVERGED, f"another episode afterwards ({found.outcome}: {found.note})")


def judge(row: Row, only: Collection[tuple[str, str]] | None = None) -> list[dict[str, str]]:
    """All cells of a row, or those of some faults and variants, as rows of the CSV file."""
    clean = plain(row.open().episode())
    found = []
    for (fault, variant), cell in cells(row).items():
        if only is None or (fault, variant) in only:
            ended = outcome(row, cell, clean)
            note = " ".join(ended.note.split())[:200]
            values = (row.kind, row.name, row.case, fault, variant, str(ended.outcome), note)
            found.append(dict(zip(COLUMNS, values, strict=True)))
    return found


def read() -> list[dict[str, str]]:
    """The cells that are known."""
    if not RESULTS.exists():
        return []
    with RESULTS.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def write(found: list[dict[str, str]]) -> None:
    """The CSV file, in the order of the rows, and the tables."""
    order = {(row.name, row.case): place for place, row in enumerate(rows())}
    kept = [cell for cell in found if (cell["row"], cell["example"]) in order]
    kept.sort(key=lambda cell: order[cell["row"], cell["example"]])
    with RESULTS.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(kept)
    first = next(rows())
    faults = {group: list(dict.fromkeys(fault for fault, _ in cells(first, (group,)))) for group in GROUPS}
    RESULTS.with_suffix(".md").write_text(markdown(kept, faults), encoding="utf-8")


def main() -> None:
    """Judge what is not known yet, or one row anew, and write both files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--only", default="", help="the exported name of a wrapper or constraint")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    known = [] if arguments.only else read()
    found = [cell for cell in read() if cell["row"] != arguments.only]
    done = {(cell["row"], cell["example"]) for cell in known}
    for row in rows(arguments.only):
        if (row.name, row.case) in done:
            continue
        judged = judge(row)
        found += judged
        write(found)
        bad = [cell for cell in judged if cell["outcome"] in DEFECTS]
        print(f"{row.name} {row.case}: {len(judged)} cells, {len(bad)} defects", flush=True)
        for cell in bad:
            print("   ", *(cell[name] for name in COLUMNS[3:]), flush=True)
    sys.exit(any(cell["outcome"] in DEFECTS for cell in found))


if __name__ == "__main__":
    main()
