"""What the library's docstrings mean and Sphinx does not: absolute values, colons in prose, NumPy's type aliases."""

import re
from typing import Any

from sphinx.application import Sphinx

_BAR = re.compile(r"(`+)(?:(?!\1).)*\1|\|")
"""A span in backticks, or a bar outside of them."""
_ARRAY_LIKE = re.compile(r"~numpy\._typing\.\S+ \| .*?_NestedSequence\[[a-z |]+\]")
_ARRAY = re.compile(r"~numpy\.ndarray\[tuple\[~typing\.Any, \.\.\.\], ~numpy\.dtype\[~numpy\.(\w+)\]\]")


def _escape(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """`|x|` is an absolute value here and a substitution there; types of returns are in the signature.

    And whoever reads of "the appendix" finds which one.
    """
    for i, line in enumerate(lines):
        if i and lines[i - 1].strip() == "Returns:":
            # What stands before a colon would be taken for a type: let that be nothing.
            indent = len(line) - len(line.lstrip())
            line = line[:indent] + ": " + line[indent:]
            lines[i] = line
        if not line.lstrip().startswith((">>>", "...")):
            line = _BAR.sub(lambda m: m[0] if m[0] != "|" else r"\|", line)
            lines[i] = line.replace("Source: appendix", "Source: :doc:`appendix </references>`")


def _shorten(
    app: Sphinx,
    what: str,
    name: str,
    obj: Any,
    options: Any,
    signature: str | None,
    returns: str | None,
) -> tuple[str | None, str | None]:
    """NumPy's aliases are expanded by the time they come here."""
    short = (
        None if part is None else _ARRAY.sub(r"NDArray[\1]", _ARRAY_LIKE.sub("ArrayLike", part))
        for part in (signature, returns)
    )
    one, two = short
    return one, two


def setup(app: Sphinx) -> dict[str, bool]:
    """Register both."""
    app.connect("autodoc-process-docstring", _escape, priority=400)  # before napoleon
    app.connect("autodoc-process-signature", _shorten)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
