"""The matrix as tables: wrappers and constraints down, faults across; rows that agree are one."""

from collections import Counter
from collections.abc import Iterable

from benchmarks.faults.outcomes import MEANS, Outcome

Cells = list[dict[str, str]]


def markdown(found: Cells, groups: dict[str, list[str]]) -> str:
    """All tables.

    Args:
        found: Rows of the CSV file.
        groups: Heading -> its faults, in order.
    """
    parts = [_counts(found)]
    for heading, faults in groups.items():
        for kind in ("wrapper", "constraint"):
            mine = [cell for cell in found if cell["kind"] == kind]
            parts.append(f"**{heading}: {kind}s**\n\n" + _table(mine, kind, faults))
    return "\n\n".join(parts) + "\n"


def _counts(found: Cells) -> str:
    counted = Counter(cell["outcome"] for cell in found)
    lines = [f"| {one} | {counted[one]:,} | {MEANS[one]} |" for one in Outcome]
    return "\n".join(["| outcome | cells | means |", "|---|---|---|", *lines])


def _table(found: Cells, kind: str, faults: list[str]) -> str:
    rows: dict[tuple[str, ...], list[str]] = {}
    for name in dict.fromkeys(cell["row"] for cell in found):
        mine = [cell for cell in found if cell["row"] == name]
        key = tuple(_said(cell["outcome"] for cell in mine if cell["fault"] == fault) for fault in faults)
        rows.setdefault(key, []).append(f"`{name}`")
    lines = [f"| {', '.join(names)} | {' | '.join(key)} |" for key, names in rows.items()]
    return "\n".join([f"| {kind} | {' | '.join(faults)} |", "|---" * (len(faults) + 1) + "|", *lines])


def _said(outcomes: Iterable[str]) -> str:
    """Every outcome of a cell's variants once; what does not apply only where nothing else does."""
    there = set(outcomes)
    said = [str(one) for one in Outcome if one in there and one is not Outcome.NOT_APPLICABLE]
    return ", ".join(said) or str(Outcome.NOT_APPLICABLE)
