"""Everything this library raises on purpose, and the checks of arguments that raise it.

Each check returns the value in one type, or raises an error that names the parameter.
"""

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
OF_NUMBERS: Final = "of numbers within float64, none of them masked"
T = TypeVar("T")


class SafeWrappersError(Exception):
    """Base class: catch it to catch every refusal of this library."""


class ConfigurationError(SafeWrappersError, ValueError):
    """A constructor or a config was given something it cannot work with."""


class UnknownNameError(ConfigurationError):
    """A body, joint, geom, constraint or config key does not exist; the message lists those that do."""


class UnsupportedEnvError(ConfigurationError):
    """The env lacks what a wrapper or a plant needs of it (Box action, MuJoCo model, known id)."""


class ActionError(SafeWrappersError, ValueError):
    """An action has the wrong shape or type; the env was not stepped."""


class RunStateError(SafeWrappersError):
    """A training run's folder cannot be used: it belongs to another config, or its checkpoint is damaged."""


class UnsafeStateWarning(UserWarning):
    """The state was already outside the safe set when the filter was asked to act; said once per episode."""


class PhaseMarginWarning(UserWarning):
    """Hold and delays leave a declared control loop less phase margin than it asks for; said once per plant."""


def positive(name: str, value: float, unit: str) -> float:
    """A finite number above zero."""
    return _number(name, value, unit, "> 0", math.ulp(0.0))


def non_negative(name: str, value: float, unit: str) -> float:
    """A finite number of at least zero."""
    return _number(name, value, unit, ">= 0", 0.0)


def _number(name: str, value: float, unit: str, bound: str, least: float) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        raise ConfigurationError(f"{name} must be a number in {unit}, got {shown(value)}") from None
    if not (math.isfinite(number) and number >= least):
        raise ConfigurationError(f"{name} must be a finite number {bound} in {unit}, got {value!r}")
    return number


def whole_number(name: str, value: Any, least: int, of: str = "") -> int:
    """A whole number, not a float; `of` says in messages what it counts."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        counted = f" of {of}" if of else ""
        raise ConfigurationError(f"{name} is a whole number{counted}, at least {least}; got {value!r}")
    return int(value)


def true_or_false(name: str, value: Any) -> bool:
    """A bool, NumPy's too, or an error that names the parameter."""
    if not isinstance(value, bool | np.bool_):
        raise ConfigurationError(f"{name} is True or False, got {value!r}")
    return bool(value)


def name_list(name: str, given: Any, of: str = "names", also: str = "", least: int = 1) -> list[str]:
    """A list of at least `least` names; `of` and `also` say in messages what they are and what else is allowed."""
    listed = isinstance(given, Sequence | np.ndarray) and not isinstance(given, str) and len(given) >= least
    if not (listed and all(isinstance(one, str) for one in given)):
        raise ConfigurationError(f"{name} is a list of {of}{', or ' + also if also else ''}; got {given!r}")
    return list(given)


def settings_from(kind: type[T], given: Any, name: str, also: str = "") -> T:
    """The given instance of the dataclass `kind`, or one made from a dict of fields; `also` as in `name_list`."""
    if isinstance(given, kind):
        return given
    if not isinstance(given, Mapping):
        raise ConfigurationError(f"{name} is a {kind.__name__}, the dict of one{also}; got {given!r}")
    parameters = inspect.signature(kind).parameters
    for key in given:
        if key not in parameters:
            raise UnknownNameError(f"{name} has no {key!r}; it has {', '.join(parameters)}")
    needed = [key for key, p in parameters.items() if p.default is p.empty and key not in given]
    if needed:
        raise ConfigurationError(f"{name} needs {' and '.join(needed)}; got {dict(given)!r}")
    return kind(**given)


def of_kind(kinds: Mapping[str, type[T]], data: Any, what: str) -> T:
    """A dataclass rebuilt from the dict of its fields, with its class under "kind"; `what` is expected."""
    if not isinstance(data, Mapping):
        raise ConfigurationError(f"expected {what} or the dict of one; got {data!r}")
    kind = data.get("kind", "")
    if not isinstance(kind, str) or kind not in kinds:
        raise UnknownNameError(f"unknown kind {kind!r}; expected {what}: the kinds are {', '.join(kinds)}")
    return settings_from(kinds[kind], {k: v for k, v in data.items() if k != "kind"}, kind)


def check_fields(settings: Any, check: Callable[..., float], names: Sequence[str], unit: str) -> None:
    """Check fields of a frozen dataclass by `positive` or `non_negative`; None stays where it is the default."""
    defaults = {field.name: field.default for field in fields(settings)}
    for name in names:
        value = getattr(settings, name)
        if value is not None or defaults[name] is not None:
            object.__setattr__(settings, name, check(name, value, unit))


def shown(value: Any) -> str:
    """A value as a message prints it."""
    try:
        text = repr(value)
    except ValueError:  # Python prints no whole number of more than 4,300 digits
        text = f"a {type(value).__name__} with a number too long to print"
    return text if len(text) <= 200 else f"{text[:200]}..."


def numbers_of(value: Any) -> NDArray[Any] | None:
    """A copy as an array of real numbers in their own dtype, finite or not.

    None where they are none: texts, lists that are no array, whole numbers beyond float64, masked entries.
    """
    if type(value) is not np.ndarray and _is_masked(value):
        return None
    try:
        array = np.array(value)
        if array.dtype.kind == "O":  # numbers of other libraries
            array = array.astype(np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    return array if array.dtype.kind in "fiub" else None


def _is_masked(value: Any) -> bool:
    return bool(np.ma.is_masked(value)) or (isinstance(value, list | tuple) and any(map(_is_masked, value)))


def finite_action(action: Any, size: int) -> Array:
    """A copy of an action of finite numbers, shape (size,); an `ActionError` for any other."""
    given = numbers_of(action)
    if given is None or given.shape != (size,) or not np.isfinite(given).all():
        raise ActionError(
            f"expected an action of {size} finite numbers, got {shown(action)}; the env was not stepped"
        )
    return given.astype(np.float64, copy=False)


def float_array(name: str, value: ArrayLike) -> Array:
    """The value as float64, any shape, finite or not."""
    try:
        if not _is_masked(value):
            return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        pass
    raise ConfigurationError(f"{name} is a number or an array {OF_NUMBERS}, got {shown(value)}")


def finite_array(name: str, value: ArrayLike) -> Array:
    """The value as finite float64, any shape."""
    array = float_array(name, value)
    if not np.isfinite(array).all():
        raise ConfigurationError(f"{name} must be finite, got {array}")
    return array


def one_number(name: str, value: Any) -> float:
    """What a function of the user's returned, as a float, finite or not."""
    if isinstance(value, float):  # np.float64 is one: the common case
        return float(value)
    array = np.asarray(value, dtype=np.float64)
    if array.size != 1:
        raise ConfigurationError(f"{name} must return one number, got an array of shape {array.shape}")
    return float(array.reshape(()))
