"""Runs a page's code: every `python` block from top to bottom, in one namespace.

A `text` block right below a `python` block is what it prints, exactly; a block without one prints nothing. So what
a page shows is what a reader gets, and `tests/docs` checks it. Pictures may run a page too, and draw what it defines.
"""

import contextlib
import io
import re
from pathlib import Path
from typing import Any, NamedTuple

DOCS = Path(__file__).parent

_BLOCK = re.compile(
    r"^```python\n(?P<code>.*?)^```\n(?:\n*^```text\n(?P<output>.*?)^```$)?",
    re.MULTILINE | re.DOTALL,
)


class Block(NamedTuple):
    """Code, the line of the page on which it begins, and what it prints."""

    line: int
    code: str
    output: str


def pages() -> list[str]:
    """Every page that has code, the README among them, as a path under docs/."""
    found = (p.relative_to(DOCS).as_posix() for p in sorted(DOCS.rglob("*.md")))
    return [page for page in ["../README.md", *found] if blocks(page)]


def blocks(page: str) -> list[Block]:
    """The blocks of a page, in order."""
    text = (DOCS / page).read_text(encoding="utf-8")
    return [
        Block(text.count("\n", 0, m.start("code")) + 1, m["code"], m["output"] or "")
        for m in _BLOCK.finditer(text)
    ]


def run(page: str, until: str | None = None) -> dict[str, Any]:
    """Run a page and return its names.

    Args:
        page: As `pages` lists it.
        until: Stop once this name is defined; None runs all.

    Raises:
        AssertionError: A block prints something else than the page says.
    """
    names: dict[str, Any] = {"__name__": "__main__"}
    for block in blocks(page):
        printed = io.StringIO()
        # Blank lines in front, so that a traceback names the page's own line.
        code = compile("\n" * (block.line - 1) + block.code, str(DOCS / page), "exec")
        with contextlib.redirect_stdout(printed):
            exec(code, names)
        assert printed.getvalue() == block.output, (
            f"{page}, line {block.line}: the page says\n{block.output}but the code prints\n{printed.getvalue()}"
        )
        if until in names:
            break
    return names
