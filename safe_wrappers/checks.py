"""Checks of arguments: each returns what it was given in one type, or raises an error that names the parameter."""

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers.deprecation import deprecated_names
from safe_wrappers.errors import ConfigurationError, UnknownNameError

Array = NDArray[np.float64]
T = TypeVar("T")


def positive(name: str, value: float, unit: str) -> float:
    """A finite number above zero, or an error that names the parameter and its unit."""
    number = _number(name, value, unit)
    if not (math.isfinite(number) and number > 0.0):
        raise ConfigurationError(f"{name} must be a finite number > 0 in {unit}, got {value!r}")
    return number


def non_negative(name: str, value: float, unit: str) -> float:
    """A finite number of at least zero, or an error that names the parameter and its unit."""
    number = _number(name, value, unit)
    if not (math.isfinite(number) and number >= 0.0):
        raise ConfigurationError(f"{name} must be a finite number >= 0 in {unit}, got {value!r}")
    return number


def _number(name: str, value: Any, unit: str) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        raise ConfigurationError(f"{name} must be a number in {unit}, got {value!r}") from None


def whole_number(name: str, value: Any, least: int, of: str = "") -> int:
    """A whole number, no float, or an error that names the parameter and what it counts."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        counted = f" of {of}" if of else ""
        raise ConfigurationError(f"{name} is a whole number{counted}, at least {least}; got {value!r}")
    return int(value)


def name_list(name: str, given: Any, of: str = "names", also: str = "", least: int = 1) -> list[str]:
    """A list of at least so many names, or an error that names the parameter and what else (`also`) it may be."""
    listed = isinstance(given, Sequence | np.ndarray) and not isinstance(given, str) and len(given) >= least
    if not (listed and all(isinstance(one, str) for one in given)):
        raise ConfigurationError(f"{name} is a list of {of}{', or ' + also if also else ''}; got {given!r}")
    return list(given)


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


def check_fields(
    settings: Any, check: Callable[[str, float, str], float], names: Sequence[str], unit: str
) -> None:
    """Put fields of a frozen dataclass through `positive` or `non_negative`; None stays where it is the default."""
    defaults = {field.name: field.default for field in fields(settings)}
    for name in names:
        value = getattr(settings, name)
        if value is not None or defaults[name] is not None:
            object.__setattr__(settings, name, check(name, value, unit))


def finite_array(name: str, value: ArrayLike) -> Array:
    """One value as float64, any shape.

    Raises:
        ConfigurationError: What is no number, or not finite; it names the argument.
    """
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ConfigurationError(f"{name} is a number or an array of numbers, got {value!r}") from None
    if not np.isfinite(array).all():
        raise ConfigurationError(f"{name} must be finite, got {array}")
    return array


def finite_arrays(**values: ArrayLike) -> list[Array]:
    """The values as float64, broadcast together, in the order given.

    Raises:
        ConfigurationError: What is no number, or not finite, or shapes that do not broadcast.
    """
    arrays = [finite_array(name, value) for name, value in values.items()]
    try:
        return list(np.broadcast_arrays(*arrays))
    except ValueError:
        shapes = ", ".join(f"{name} {array.shape}" for name, array in zip(values, arrays, strict=True))
        raise ConfigurationError(f"expected shapes that broadcast together, got {shapes}") from None
