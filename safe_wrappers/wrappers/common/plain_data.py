"""Dataclasses of settings as plain data, and back: for specs, configs and JSON."""

import inspect
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

from safe_wrappers.deprecation import deprecated_names
from safe_wrappers.errors import ConfigurationError, UnknownNameError
from safe_wrappers.filter.constraint import Constraint
from safe_wrappers.serialize import constraint_data

T = TypeVar("T")


def settings_from(kind: type[T], given: Any, name: str, also: str = "") -> T:
    """An instance of a dataclass itself, or made from the dict of its fields.

    Args:
        kind: The dataclass.
        given: The instance or the dict.
        name: Of the parameter, for messages.
        also: What else the parameter takes, for messages.

    Raises:
        ConfigurationError: Neither, or a field without a default is missing.
        UnknownNameError: A key that is no field.
    """
    if isinstance(given, kind):
        return given
    if not isinstance(given, Mapping):
        raise ConfigurationError(f"{name} is a {kind.__name__}, the dict of one{also}; got {given!r}")
    parameters = inspect.signature(kind).parameters
    old = deprecated_names(kind)
    for key in given:
        if key not in parameters and key not in old:
            raise UnknownNameError(f"{name} has no {key!r}; it has {', '.join(parameters)}")
    needed = [key for key, p in parameters.items() if p.default is p.empty and key not in given]
    if needed and not any(key in old for key in given):
        raise ConfigurationError(f"{name} needs {' and '.join(needed)}; got {dict(given)!r}")
    return kind(**given)


def plain_data(value: Any) -> Any:
    """The dict of a dataclass of settings, with constraints in it as their dicts; anything else as it is."""
    if isinstance(value, Constraint):
        return constraint_data(value)
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain_data(getattr(value, field.name)) for field in fields(value)}
    return value


def recorded(arguments: Mapping[str, Any], **plain: Any) -> dict[str, Any]:
    """A constructor's arguments for Gymnasium's `RecordConstructorArgs`.

    Args:
        arguments: A copy of `locals()` from the constructor's first line.
        plain: Those of them that are recorded as plain data.
    """
    return {name: value for name, value in {**arguments, **plain}.items() if name not in ("self", "env")}
