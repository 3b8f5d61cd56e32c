"""The keys of a config, from the fields of `safe_wrappers.train.config.models`.

Without Sphinx, so that `tests/train` reads it too.
"""

import types
from dataclasses import is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

import yaml

from safe_wrappers.train.config import models

_TYPES = {
    int: "integer",
    float: "number",
    bool: "true or false",
    str: "text",
    Path: "path",
    dict: "mapping",
}
_WRITTEN = {
    "arms": "mapping",
    "env.judge": "`constraints`",
    "env.observation": "`constraints`",
    "sweep": "mapping",
}
"""Types in YAML where Python has another one."""


class Key(NamedTuple):
    """A key, its type in YAML, its default and what it means."""

    name: str
    type: str
    default: str
    meaning: str


def keys(section: str, prefix: str = "") -> list[Key]:
    """The keys of a section; those of an inner one that has no description of its own are among them.

    Args:
        section: The name of a dataclass of the models.
        prefix: Where the section stands in a config, such as "env.".
    """
    found = []
    for name, field in getattr(models, section).__pydantic_fields__.items():
        if is_dataclass(field.annotation) and field.description is None:
            found += keys(field.annotation.__name__, f"{prefix}{name}.")
        elif field.description is not None:
            default = (
                "required"
                if field.is_required()
                else _default(field.get_default(call_default_factory=True))
            )
            kind = _WRITTEN.get(prefix + name) or _type(field.annotation)
            found.append(
                Key(prefix + name, kind, default, " ".join(field.description.split()))
            )
    return found


def _type(annotation: Any) -> str:
    if get_origin(annotation) in (Annotated, Union, types.UnionType):
        return _type(get_args(annotation)[0])  # of `X | None` the default is null
    if get_origin(annotation) is Literal:
        return ", ".join(f"`{name}`" for name in get_args(annotation))
    if get_origin(annotation) is list:
        of = _type(get_args(annotation)[0])
        return f"list of {of}" + "s" * of.isalpha()
    if is_dataclass(annotation):
        return "text or mapping"
    return _TYPES[get_origin(annotation) or annotation]


def _default(value: Any) -> str:
    value = getattr(value, "kind", value)  # a filter, a learner
    text = yaml.safe_dump(
        str(value) if isinstance(value, Path) else value, default_flow_style=True
    )
    return f"`{text.removesuffix('...' + chr(10)).strip()}`"
