"""Calls of constructors that do not fit their arguments: refused with what the docstring says of these."""

import difflib
import functools
import inspect
import re
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

from safe_wrappers.errors import CallError

T = TypeVar("T")


def refuse_call(kind: type[Any], args: Sequence[Any], kwargs: Mapping[str, Any]) -> None:
    """Refuse arguments that a class does not take, or a call that lacks one.

    Raises:
        CallError: The message has the argument's meaning, or the arguments that there are.
    """
    taken = inspect.signature(kind).parameters
    if any(one.kind is one.VAR_KEYWORD for one in taken.values()):
        return
    names = [name for name, one in taken.items() if one.kind is not one.VAR_POSITIONAL]
    for name in kwargs:
        if name not in names:
            near = difflib.get_close_matches(name, names, n=1)
            hint = f" (did you mean {near[0]!r}?)" if near else ""
            raise CallError(f"{kind.__name__} takes no {name!r}{hint}; it takes {', '.join(names)}")
    given = [*names[: len(args)], *kwargs]
    for name in names:
        if taken[name].default is inspect.Parameter.empty and name not in given:
            raise CallError(f"{kind.__name__} needs {name}{_meaning(kind, name)}")


def tells_arguments(kind: type[T]) -> type[T]:
    """Class decorator: calls that do not fit are refused by `refuse_call`, and no more by a bare TypeError."""
    untyped: Any = kind
    init = untyped.__init__

    @functools.wraps(init)
    def telling(self: Any, *args: Any, **kwargs: Any) -> None:
        try:
            init(self, *args, **kwargs)
        except TypeError:
            refuse_call(type(self), args, kwargs)
            raise

    untyped.__init__ = telling
    return kind


def _meaning(kind: type[Any], name: str) -> str:
    """What the docstring says of an argument, or else of the class, after a colon."""
    text = inspect.getdoc(kind) or ""
    found = re.search(rf"^    (?:\w+, )*{name}: (.*?)(?=^    \w|^\S|^$|\Z)", text, re.MULTILINE | re.DOTALL)
    return f": {' '.join((found[1] if found else text.partition(chr(10))[0]).split())}"
