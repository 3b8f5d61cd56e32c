"""Constraints, obstacles and settings as plain data: to record a wrapper, rebuild it, and write it as JSON."""

from dataclasses import fields, is_dataclass
from typing import Any

from safe_wrappers import constraints
from safe_wrappers.constraints.obstacles import KINDS as OBSTACLES
from safe_wrappers.errors import of_kind
from safe_wrappers.filter.constraint import Constraint

_EXPORTED = [getattr(constraints, name) for name in constraints.__all__ if name != "Constraint"]
KINDS: dict[str, type[Constraint]] = {
    kind.__name__: kind for kind in _EXPORTED if issubclass(kind, Constraint)
}


def constraint_from(data: Any) -> Constraint:
    """A constraint itself, or rebuilt from its `plain_data`."""
    if isinstance(data, Constraint):
        return data
    return of_kind(KINDS, data, "a constraint (an instance of a subclass of sw.Constraint)")


def plain_data(value: Any) -> Any:
    """The dict of a dataclass of this library, or a list of such dicts; any other value unchanged.

    Constraints and obstacles have their class under `kind`. One that holds functions or models is left unchanged.
    """
    if isinstance(value, list | tuple) and any(is_dataclass(one) for one in value):
        return [plain_data(one) for one in value]
    kind = type(value)
    known = kind in KINDS.values() or kind in OBSTACLES.values()
    ours = is_dataclass(kind) and kind.__module__.startswith("safe_wrappers.")
    if not known and (not ours or isinstance(value, Constraint)):
        return value
    names = [one.name for one in fields(value) if one.init and one.name != "promise"]
    if known and any(_holds_functions(getattr(value, name)) for name in names):
        return value
    data = {name: plain_data(getattr(value, name)) for name in names}
    return {"kind": kind.__name__, **data} if known else data


def _holds_functions(value: Any) -> bool:
    if isinstance(value, list | tuple):
        return any(_holds_functions(one) for one in value)
    return callable(value) or hasattr(value, "predict")
