"""Refuses an unknown name with the nearest valid one."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from safe_wrappers.errors import UnknownNameError

_MANY = 40
"""More names than this are not all listed, only those that come near."""


def check_name(name: object, valid: Iterable[str], what: str) -> str:
    """Returns the name if it is valid.

    Args:
        name: What was given.
        valid: The names that exist.
        what: What kind of name it is and where it stands, for the message.

    Returns:
        The name.

    Raises:
        UnknownNameError: It does not exist; the message holds the nearest one and the others (or, of
            many, those that come near).
    """
    options = sorted(valid)
    if isinstance(name, str) and name in options:
        return name
    near = difflib.get_close_matches(str(name), options, n=1, cutoff=0.5)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    if len(options) > _MANY:
        options = [*difflib.get_close_matches(str(name), options, n=8, cutoff=0.3), "..."]
    raise UnknownNameError(f"{what}: unknown name {name!r}.{hint} Valid names: {', '.join(options)}.")
