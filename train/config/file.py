"""A YAML file and `key=value` overrides, as a plain dict that nothing has judged yet."""

from __future__ import annotations

import re
from collections.abc import Hashable, Sequence
from pathlib import Path
from typing import Any

import yaml

from safe_wrappers.errors import ConfigurationError


class _Loader(yaml.SafeLoader):
    """YAML 1.1 as people mean it: `3e-4` is a number, and a key given twice is a mistake."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[object] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if key in seen:
                raise ConfigurationError(f"{key!r} is given twice (line {key_node.start_mark.line + 1}).")
            seen.add(key)
        return super().construct_mapping(node, deep)


# PyYAML reads 3e-4 as a string (it wants 3.0e-4): a learning rate that is silently no number.
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?[0-9]+[eE][-+]?[0-9]+$"), list("-+0123456789")
)


def read_config(path: Path, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """Reads a config file and applies overrides such as `total_steps=1000` or `arms.filtered.filter=protect`.

    Args:
        path: The YAML file.
        overrides: `dotted.key=value` texts; values are read as YAML. Later ones win.

    Returns:
        The settings, unchecked.

    Raises:
        ConfigurationError: No such file, not YAML, not a mapping, or an override that is not `key=value`.
    """
    if not path.is_file():
        near = sorted(str(p) for p in path.parent.glob("*.yaml")) if path.parent.is_dir() else []
        there = f" Configs there: {', '.join(near)}." if near else ""
        raise ConfigurationError(f"There is no config file {str(path)!r}.{there}")
    settings = _load(path.read_text(), str(path))
    if not isinstance(settings, dict):
        raise ConfigurationError(
            f"{path}: expected a mapping of settings (`key: value` lines), got {settings!r}."
        )
    for override in overrides:
        key, equals, value = override.partition("=")
        if not equals or not key:
            raise ConfigurationError(f"Override {override!r}: expected key=value, such as total_steps=1000.")
        set_value(settings, key, _load(value, f"override {override!r}"), f"Override {override!r}")
    return settings


def _load(text: str, where: str) -> Any:
    try:
        return yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        raise ConfigurationError(f"{where}: not valid YAML: {error}") from None
    except ConfigurationError as error:
        raise ConfigurationError(f"{where}: {error}") from None


def set_value(settings: dict[str, Any], key: str, value: Any, what: str) -> None:
    """Gives a setting another value, in place.

    Args:
        settings: As `read_config` returns them.
        key: With dots, such as `arms.filtered.filter`.
        value: The new one.
        what: Who asks for it, for the refusal.

    Raises:
        ConfigurationError: There is a value that has no keys where the key has more.
    """
    keys = key.split(".")
    for depth, outer in enumerate(keys[:-1]):
        inner = settings.setdefault(outer, {})
        if inner is None:  # `arms: {filtered:}` is an empty mapping in disguise
            inner = settings[outer] = {}
        if not isinstance(inner, dict):
            raise ConfigurationError(
                f"{what}: {'.'.join(keys[: depth + 1])} is {inner!r}, with no keys inside."
            )
        settings = inner
    settings[keys[-1]] = value
