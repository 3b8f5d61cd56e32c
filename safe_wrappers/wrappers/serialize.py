"""Constructor arguments as plain data: to record a wrapper, rebuild it, and write it as JSON."""

import os
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from safe_wrappers import constraints
from safe_wrappers.constraints.obstacles import KINDS as OBSTACLES
from safe_wrappers.errors import of_kind
from safe_wrappers.filter.constraint import Constraint
from safe_wrappers.plants import Plant, PlantTemplate

_EXPORTED = [getattr(constraints, name) for name in constraints.__all__]
KINDS: dict[str, type[Constraint]] = {k.__name__: k for k in _EXPORTED if issubclass(k, Constraint)}


def constraint_from(data: Any) -> Constraint:
    """A constraint itself, or rebuilt from its `plain_data`."""
    if isinstance(data, Constraint):
        return data
    return of_kind(KINDS, data, "a constraint (an instance of a subclass of sw.Constraint)")


def plain_data(value: Any) -> Any:
    """An argument as plain data, where it is any, with all that it holds; a plant as a template.

    A dataclass of this library is the dict of its fields; constraints and obstacles have their class under `kind`.
    One of these that holds functions or models is left unchanged.
    """
    if isinstance(value, Plant):
        return PlantTemplate(value)
    if isinstance(value, Mapping):
        return {name: plain_data(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [plain_data(one) for one in value]
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
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
