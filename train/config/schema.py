"""The JSON schema of a config file, from which editors complete keys and mark mistakes: `safe-wrappers schema`."""

from __future__ import annotations

import re
from typing import Any, Final

from pydantic import TypeAdapter

from . import models
from .algorithms import ALGORITHMS
from .load import COMMON_KEYS

_STANDARD: Final = {"ge": "minimum", "gt": "exclusiveMinimum", "le": "maximum"}
_WHOLE: Final = [{"type": "integer"}, {"type": "string", "pattern": r"^\d[\d_]*$"}]
"""Editors read YAML 1.2, in which `100_000` is a text."""
_SHORT: Final = {"FilterConfig": {"enum": ["none", "protect"]}}
"""Texts that stand for a section; of the other sections `text_is` says it."""


def config_schema() -> dict[str, Any]:
    """What a config may say. What does not go together, only the command itself can tell."""
    whole = TypeAdapter(models.ExperimentConfig).json_schema()
    sections: dict[str, Any] = whole.pop("$defs")
    for name in ("judge", "observation"):
        sections["EnvConfig"]["properties"][name] |= {"anyOf": [{"const": "constraints"}]}
    arm = sections["ArmConfig"]
    del arm["properties"]["name"], arm["required"]
    arm["properties"]["algorithm"]["enum"] = list(ALGORITHMS)
    common = {key: arm["properties"][key] for key in COMMON_KEYS}
    whole["properties"] = common | whole["properties"]
    whole["properties"]["arms"] = {
        "type": "object",
        "minProperties": 1,
        "description": whole["properties"]["arms"]["description"],
        "additionalProperties": _or_nothing({"$ref": "#/$defs/ArmConfig"}),
    }
    whole["required"] = ["name", "env", "algorithm", "total_steps", "arms", "seeds"]
    definitions = {name: _section(name, _for_yaml(section)) for name, section in sections.items()}
    dialect = "http://json-schema.org/draft-07/schema#"  # the newest that editors of YAML know
    return {"$schema": dialect, **_for_yaml(whole), "title": "safe-wrappers experiment", "$defs": definitions}


def _section(name: str, section: dict[str, Any]) -> dict[str, Any]:
    """A section, or the text that may stand for it."""
    key = getattr(models, name).text_is  # the text is what that key says
    short = _SHORT.get(name) or (section["properties"][key] if key else None)
    return {"anyOf": [short, section]} if short else section


def _for_yaml(part: Any) -> Any:
    """A part of pydantic's schema in standard words, for YAML: a key with a default needs no value."""
    if isinstance(part, list):
        return [_for_yaml(each) for each in part]
    if not isinstance(part, dict):
        return part
    found = {_STANDARD.get(key, key): _for_yaml(value) for key, value in part.items() if key != "title"}
    told = {key: found.pop(key) for key in ("description", "default") if key in found}
    if isinstance(told.get("description"), str):  # links lead to pages that an editor does not have
        told["description"] = " ".join(re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", told["description"]).split())
    if found.get("type") == "integer":
        found = {"anyOf": [{**found, **each} for each in _WHOLE]}
    if "type" in found and "properties" in found:
        required = found.get("required", ())
        found["properties"] = {
            key: each if key in required else _or_nothing(each) for key, each in found["properties"].items()
        }
    return told | found


def _or_nothing(part: dict[str, Any]) -> dict[str, Any]:
    told = {key: part[key] for key in ("description", "default") if key in part}
    rest = {key: value for key, value in part.items() if key not in told}
    return told | {"anyOf": [*rest.get("anyOf", [rest]), {"type": "null"}]}
