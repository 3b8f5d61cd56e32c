"""Tables of benchmarks in Markdown, and the files that a benchmark leaves."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

RESULTS: Final = Path(__file__).parent / "results"


def markdown(head: str, rows: Iterable[Iterable[object]]) -> str:
    """A table.

    Args:
        head: Names of the columns with bars between them.
        rows: Cells, each as its text.
    """
    lines = [f"| {head} |", "|---" * (head.count("|") + 1) + "|"]
    return "\n".join([*lines, *(f"| {' | '.join(map(str, cells))} |" for cells in rows)])


def keep(folder: Path, name: str, rows: Any, text: str) -> None:
    """Writes rows as `NAME.json` and the text that shows them as `NAME.md`, and prints the text."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.json").write_text(json.dumps(rows, indent=1) + "\n")
    (folder / f"{name}.md").write_text(text + "\n")
    print(text)


def total(rows: Iterable[dict[str, Any]], key: str) -> int:
    """A count over all rows."""
    return sum(int(row[key]) for row in rows)
