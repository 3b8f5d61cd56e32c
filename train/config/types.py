"""The types of settings, and refusals that say the place, what was expected and what came."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping
from dataclasses import fields
from typing import Annotated, Any, ClassVar

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    TypeAdapter,
    ValidationError,
    model_validator,
)
from pydantic.dataclasses import dataclass
from pydantic_core import ArgsKwargs

from safe_wrappers.errors import ConfigurationError, UnknownNameError

_MANY = 40
"""More names than this are not all listed, only those that come near."""


def check_name(name: object, valid: Iterable[str], where: str = "") -> str:
    """Returns the name if it is valid.

    Raises:
        UnknownNameError: It does not exist; the message holds the place, the nearest name and the others (or, of
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


def matching(pattern: str, expected: str) -> AfterValidator:
    """A text of this pattern, in words for the refusal."""

    def check(text: str) -> str:
        if not re.fullmatch(pattern, text):
            raise ConfigurationError(f"expected {expected}, got {text!r}.")
        return text

    return AfterValidator(check)


def _whole(value: Any) -> Any:
    return int(value) if isinstance(value, float) and value.is_integer() else value  # 3e5 steps


Options = dict[str, Any]
Integer = Annotated[int, Field(strict=True), BeforeValidator(_whole)]
Count = Annotated[Integer, Field(ge=1)]
NonNegative = Annotated[Integer, Field(ge=0)]
Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
FunctionName = Annotated[str, matching(r"[\w.]+:\w+", "'module:function'")]
FolderName = Annotated[
    str,
    matching(r"[A-Za-z0-9][\w.-]*", "a name that can be a folder's (letters, digits, '_', '-', '.')"),
]


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

    def plain(self) -> dict[str, Any]:
        """What JSON can keep, without the keys that are None; `validate` makes the same section of it."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {
            name: value.plain() if isinstance(value, Section) else value
            for name, value in values.items()
            if value is not None
        }


def validate(kind: Any, value: Any, where: str) -> Any:
    """Returns a setting as its type has it; `where` is its place in the config, such as "arms.a".

    Raises:
        UnknownNameError: A name that does not exist; the message has the nearest one and all others.
        ConfigurationError: Anything else that does not fit.
    """
    try:
        return TypeAdapter(kind).validate_python(value)
    except ValidationError as error:
        refused = error.errors()[0]
    keys = [where, *map(str, refused["loc"])] if where else [str(key) for key in refused["loc"]]
    if refused["type"] == "missing":
        raise ConfigurationError(f"{'.'.join(keys[:-1]) or 'config'}: {keys[-1]!r} is missing.")
    place, context, given = ".".join(keys), refused.get("ctx", {}), refused["input"]
    cause = context.get("error")
    if isinstance(cause, ConfigurationError):  # a validator's own words
        raise type(cause)(f"{place}: {cause}")
    raise ConfigurationError(f"{place}: {refused['msg'][0].lower()}{refused['msg'][1:]}, got {given!r}.")
