"""What the faults' parameters may be."""

from safe_wrappers.checks import non_negative
from safe_wrappers.errors import ConfigurationError


def probability(name: str, value: float) -> float:
    """A number from 0 to 1, or an error that names the parameter."""
    number = non_negative(name, value, "a probability")
    if number > 1.0:
        raise ConfigurationError(f"{name} is a probability from 0 to 1, got {value!r}")
    return number
