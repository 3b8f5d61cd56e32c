"""Old names that keep working: each use gives one DeprecationWarning that says how to write it now."""

import functools
import inspect
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from typing import Any, TypeVar

from safe_wrappers.errors import ConfigurationError

T = TypeVar("T")


def deprecated_parameters(
    renamed: Mapping[str, str] | None = None,
    moved: Mapping[str, type[Any]] | None = None,
    positional: Sequence[str] = (),
) -> Callable[[type[T]], type[T]]:
    """Class decorator: the constructor still takes parameters that were renamed, or moved into a dataclass.

    Args:
        renamed: Old name to new name; a call that gives both raises a ConfigurationError.
        moved: Parameter to the dataclass that it takes now. The constructor accepts its fields as keywords; an
            argument at the parameter's place is then the first field.
        positional: Old names of positional arguments after the present ones.
    """
    renames, moves = dict(renamed or {}), dict(moved or {})
    homes = {field.name: parameter for parameter, kind in moves.items() for field in fields(kind)}

    def decorate(kind: type[T]) -> type[T]:
        untyped: Any = kind
        init = untyped.__init__
        signature = inspect.signature(init)
        places = sum(p.kind is not p.KEYWORD_ONLY for p in signature.parameters.values())

        @functools.wraps(init)
        def accepting(*args: Any, **kwargs: Any) -> None:
            old = dict(zip(positional, args[places:], strict=False))
            old |= {name: kwargs.pop(name) for name in (*renames, *homes) if name in kwargs}
            if not old or len(args) > places + len(positional):
                init(*args, **kwargs)
                return
            bound = signature.bind_partial(*args[:places], **kwargs)
            new: dict[str, Any] = {}
            for name, value in old.items():
                if name in homes:
                    new.setdefault(homes[name], {})[name] = value
                elif renames[name] in bound.arguments:
                    what = f"{name} is the old name of {renames[name]}"
                    raise ConfigurationError(f"{kind.__name__}: {what}; give one")
                else:
                    new[renames[name]] = value
            written = []
            for parameter, value in new.items():
                words = "..."
                if parameter in moves:
                    first = fields(moves[parameter])[0].name
                    value = {first: bound.arguments.get(parameter)} | value
                    words = f"{moves[parameter].__name__}({', '.join(f'{name}=...' for name in value)})"
                    value = moves[parameter](**value)
                written.append(f"{parameter}={words}")
                bound.arguments[parameter] = value
            message = (
                f"{kind.__name__}: {', '.join(old)} {'is' if len(old) == 1 else 'are'} deprecated; write "
            )
            message += f"{kind.__name__}(..., {', '.join(written)})"
            around = untyped.__init__ is not accepting  # a function that tells of missing arguments
            warnings.warn(message, DeprecationWarning, stacklevel=2 + around)
            init(*bound.args, **bound.kwargs)

        untyped.__init__ = accepting
        untyped.__init__.deprecated_parameters = (*renames, *homes)
        return kind

    return decorate


def deprecated_names(kind: type[Any]) -> tuple[str, ...]:
    """Old names of parameters that a constructor still takes."""
    return getattr(kind.__init__, "deprecated_parameters", ())


def deprecated_attribute(old: str, new: str) -> Any:
    """A property of the old name that reads and sets the attribute of the new one."""

    def read(self: Any) -> Any:
        _warn(type(self), old, new)
        return getattr(self, new)

    def write(self: Any, value: Any) -> None:
        _warn(type(self), old, new)
        setattr(self, new, value)

    return property(read, write, doc=f"Old name of `{new}`.")


def deprecated_method(old: str, new: str) -> Any:
    """A method that calls the one of the new name."""

    def method(self: Any, *args: Any, **kwargs: Any) -> Any:
        _warn(type(self), old, new)
        return getattr(self, new)(*args, **kwargs)

    method.__doc__ = f"Old name of `{new}`."
    return method


def _warn(kind: type[Any], old: str, new: str) -> None:
    warnings.warn(f"{kind.__name__}.{old} is deprecated; write {new}", DeprecationWarning, stacklevel=3)
