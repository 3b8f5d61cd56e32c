"""Mappings of a config that hold arguments: which names they may have."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields
from typing import Any

from pydantic import AfterValidator

from safe_wrappers.errors import ConfigurationError
from safe_wrappers.wrappers.faults import FAULTS
from safe_wrappers.wrappers.lease_expiry import LeaseExpiry
from safe_wrappers.wrappers.stopping_budget import StoppingBudget

from .names import check_name


def with_keys(names: Iterable[str]) -> AfterValidator:
    """A mapping may have these keys."""
    valid = tuple(names)

    def check(given: Any) -> Any:
        for name in given or {}:
            check_name(name, valid)
        return given

    return AfterValidator(check)


def arguments(of: Callable[..., Any], *not_in_yaml: str) -> list[str]:
    """The names of the arguments that a config can give."""
    return [name for name in inspect.signature(of).parameters if name not in ("env", *not_in_yaml)]


def check_lease(given: Any) -> Any:
    """Arguments of a LeaseExpiry, and the fields of its budget."""
    valid = arguments(LeaseExpiry, "plant", "measured")
    for name in given or {}:
        check_name(name, valid)
    budget = (given or {}).get("budget")
    if not isinstance(budget, Mapping | None):
        raise ConfigurationError(
            f"lease.budget: expected a mapping of a StoppingBudget's fields, got {budget!r}"
        )
    for name in budget or ():
        check_name(name, [field.name for field in fields(StoppingBudget)], "budget")
    return given


def check_faults(given: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Faults by name, and the arguments of each."""
    for fault in given:
        check_name(fault, FAULTS)
        for name in given[fault]:
            check_name(name, arguments(FAULTS[fault]), fault)
    return given
