"""Lists of names in a model or an env."""

from collections.abc import Sequence
from typing import Any

from safe_wrappers.errors import ConfigurationError


def name_list(field: str, given: Any, needed: str | None = None) -> list[str]:
    """A list of names as plain data, or an error.

    With `needed`, which says what the names are of or what to give instead, it must not be empty.
    """
    listed = isinstance(given, Sequence) and all(isinstance(name, str) for name in given)
    if isinstance(given, str) or not listed or (needed is not None and not given):
        raise ConfigurationError(f"{field} is a list of names{needed or ''}, got {given!r}")
    return list(given)
