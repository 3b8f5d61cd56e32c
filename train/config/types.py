"""The types of settings, and `validate`: a refusal has the place, what was expected and what came."""

from __future__ import annotations

import re
from collections.abc import Container
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field, TypeAdapter, ValidationError

from safe_wrappers.errors import ConfigurationError

from .names import check_name


def _whole(value: Any) -> Any:
    return int(value) if isinstance(value, float) and value.is_integer() else value  # 3e5 steps


def matching(pattern: str, expected: str) -> AfterValidator:
    """A text of this pattern, in words for the refusal."""

    def check(text: str) -> str:
        if not re.fullmatch(pattern, text):
            raise ConfigurationError(f"expected {expected}, got {text!r}.")
        return text

    return AfterValidator(check)


Integer = Annotated[int, Field(strict=True), BeforeValidator(_whole)]
Count = Annotated[Integer, Field(ge=1)]
NonNegative = Annotated[Integer, Field(ge=0)]
Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
FunctionName = Annotated[str, matching(r"[\w.]+:\w+", "'module:function'")]
FolderName = Annotated[
    str,
    matching(r"[A-Za-z0-9][\w.-]*", "a name that can be a folder's (letters, digits, '_', '-', '.')"),
]


def validate(kind: Any, value: Any, where: str, inherited: Container[str] = ()) -> Any:
    """Returns a setting as its type has it.

    Args:
        kind: Any type that pydantic knows.
        value: What the config says.
        where: The setting's place in the config, such as "arms.a"; "" for the whole.
        inherited: Keys of `value` whose place is the top of the config.

    Raises:
        UnknownNameError: A name that does not exist; the message has the nearest one and all others.
        ConfigurationError: Anything else that does not fit.
    """
    try:
        return TypeAdapter(kind).validate_python(value)
    except ValidationError as error:
        refused = error.errors()[0]
    keys = [str(key) for key in refused["loc"]]
    if where and not (keys and keys[0] in inherited):
        keys.insert(0, where)
    if refused["type"] == "missing":
        raise ConfigurationError(f"{'.'.join(keys[:-1]) or 'config'}: {keys[-1]!r} is missing.")
    place, context, given = ".".join(keys), refused.get("ctx", {}), refused["input"]
    if refused["type"] == "literal_error":
        check_name(given, re.findall("'(.*?)'", context["expected"]), place)
    cause = context.get("error")
    if isinstance(cause, ConfigurationError):  # a validator's own words
        raise type(cause)(f"{place}: {cause}")
    raise ConfigurationError(f"{place}: {refused['msg'][0].lower()}{refused['msg'][1:]}, got {given!r}.")
