"""Refuses an unknown name with the nearest valid one."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from safe_wrappers.errors import UnknownNameError

_MANY = 40
"""More names than this are not all listed, only those that come near."""


def check_name(name: object, valid: Iterable[str], where: str = "") -> str:
    """Returns the name if it is valid.

    Args:
        name: What was given.
        valid: The names that exist.
        where: Where it stands, for the message; a validator of pydantic leaves it out, as `validate` adds it.

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
    place = f"{where}: " if where else ""
    raise UnknownNameError(f"{place}unknown name {name!r}.{hint} Valid names: {', '.join(options)}.")
