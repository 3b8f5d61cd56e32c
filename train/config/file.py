"""A YAML file and `key=value` overrides, as a plain dict that nothing has judged yet."""

from __future__ import annotations

import re
from collections.abc import Hashable, Sequence
from pathlib import Path
from typing import Any, Final

import yaml

from safe_wrappers.errors import ConfigurationError

_MOST: Final = 100_000
"""Values in a file. A few lines of aliases of aliases can stand for any number of them."""
_BITS: Final = 64
_PLAIN: Final = (bool, int, float, str, type(None))


class _Loader(yaml.SafeLoader):
    """YAML 1.1 as people mean it: `3e-4` is a number, and a key given twice is a mistake."""

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        try:
            found = super().construct_object(node, deep)
        except ConfigurationError:
            raise
        except (
            ValueError,
            LookupError,
            AttributeError,
        ) as error:  # `2020-13-45`, `!!bool x`, `!!timestamp x`
            kind = node.tag.rpartition(":")[2]
            raise _unreadable(node, f"{node.value!r} is no {kind} ({error})") from None
        if isinstance(found, int) and found.bit_length() > _BITS:
            raise _unreadable(node, f"a number of more than {_BITS} bits")
        return found

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[object] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str):
                raise _unreadable(key_node, f"a key is a text; {key!r} is none (put it in quotes)")
            if key in seen:
                raise ConfigurationError(f"{key!r} is given twice (line {key_node.start_mark.line + 1}).")
            seen.add(key)
        return super().construct_mapping(node, deep)


def _unreadable(node: yaml.Node, why: str) -> yaml.YAMLError:
    return yaml.constructor.ConstructorError(None, None, why, node.start_mark)


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
        ConfigurationError: No such file, not YAML, not a mapping, something that is no setting (a date, or 100,000
            values), or an override that is not `key=value`.
    """
    if not path.is_file():
        near = sorted(str(p) for p in path.parent.glob("*.yaml")) if path.parent.is_dir() else []
        there = f" Configs there: {', '.join(near)}." if near else ""
        raise ConfigurationError(f"There is no config file {str(path)!r}.{there}")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be read: {error.strerror}.") from None
    settings = _load(content, str(path))
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


def _load(content: str | bytes, where: str) -> Any:
    try:
        return _own(yaml.load(content, _Loader), [_MOST])
    except yaml.YAMLError as error:
        raise ConfigurationError(f"{where}: not valid YAML: {error}") from None
    except RecursionError:
        raise ConfigurationError(f"{where}: nested too deeply, or inside of itself.") from None
    except ConfigurationError as error:
        raise ConfigurationError(f"{where}: {error}") from None


def _own(value: Any, left: list[int]) -> Any:
    """A copy in which aliases share nothing: who changes a setting of one arm must not change another's."""
    left[0] -= 1
    if left[0] < 0:
        raise ConfigurationError(f"more than {_MOST:,} values.")
    if isinstance(value, dict):
        return {_own(key, left): _own(each, left) for key, each in value.items()}
    if isinstance(value, list):
        return [_own(each, left) for each in value]
    if not isinstance(value, _PLAIN):
        kind = type(value).__name__
        raise ConfigurationError(f"{value!r} is a {kind}; settings are numbers and texts (put it in quotes).")
    return value


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
