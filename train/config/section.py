"""Section: the base of all mappings in a config."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, ClassVar

from pydantic import ConfigDict, model_validator
from pydantic.dataclasses import dataclass
from pydantic_core import ArgsKwargs

from safe_wrappers.errors import ConfigurationError

from .names import check_name


@dataclass(frozen=True, config=ConfigDict(extra="forbid", use_attribute_docstrings=True))
class Section:
    """A mapping in a config. A key without a value has its default; a bare text stands for the key `text_is`."""

    text_is: ClassVar[str] = ""

    @model_validator(mode="before")
    @classmethod
    def _read(cls, given: Any) -> Any:
        if given is None or isinstance(given, (cls, ArgsKwargs)):
            return given or {}
        if isinstance(given, str) and cls.text_is:
            return {cls.text_is: given}
        names = [field.name for field in fields(cls)]
        if not isinstance(given, Mapping):
            raise ConfigurationError(f"expected a mapping of {', '.join(names)}; got {given!r}.")
        for name in given:
            check_name(name, names)
        return {name: value for name, value in given.items() if value is not None}
