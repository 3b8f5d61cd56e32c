"""Compiled functions of the library as functions of NVIDIA Warp: the same source, translated statement by statement.

Warp compiles a smaller Python than Numba: one type of number, no chained comparisons, no short forms for arrays, and
arrays of a size that is known only when a world is looked at have to live in a buffer that the kernel owns (`arena`;
its first number counts what is taken). `TRANSLATED` lists what no rule covers. Whatever a rule does not know, Warp
refuses, and an entry of `TRANSLATED` that no longer matches the source is an error here.
"""

import ast
import importlib.util
import inspect
import math
import sys
import tempfile
import textwrap
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any, Final

Function = Callable[..., Any]

TRANSLATED: Final = {
    "(bounds[place], order[place]) = (bounds[place - 1], order[place - 1])": """
        bounds[place] = bounds[place - 1]
        for column in range(3):
            order[place, column] = order[place - 1, column]
        """,
    "(bounds[place], order[place]) = (bound, discs[i])": """
        bounds[place] = bound
        for column in range(3):
            order[place, column] = discs[i, column]
        """,
    "(all_normals[:k], all_offsets[:k]) = (normals, offsets)": """
        for i in range(k):
            all_normals[i, 0] = normals[i, 0]
            all_normals[i, 1] = normals[i, 1]
            all_offsets[i] = offsets[i]
        """,
    "unit = np.ones(2)": "unit = pair(arena, Real(1.0), Real(1.0))",
    "force = np.minimum(np.maximum(proposal, least), most) / unit": """
        force = take(arena, 2)
        for j in range(2):
            force[j] = smaller(larger(proposal[j], least[j]), most[j]) / unit[j]
        """,
    "(inner_low, inner_high) = (least / unit, most / unit)": """
        inner_low = pair(arena, least[0] / unit[0], least[1] / unit[1])
        inner_high = pair(arena, most[0] / unit[0], most[1] / unit[1])
        """,
    "scaled = found * unit": """
        scaled = take_rows(arena, len(found), 2)
        for i in range(len(found)):
            scaled[i, 0] = found[i, 0] * unit[0]
            scaled[i, 1] = found[i, 1] * unit[1]
        """,
    "(answer, refused) = (np.zeros(2), np.array([drive, turn]))": """
        answer = take(arena, 2)
        refused = pair(arena, drive, turn)
        """,
    "tighter = exact.copy()": """
        tighter = take(arena, len(exact))
        for i in range(len(exact)):
            tighter[i] = exact[i]
        """,
}
"""Statements of the source, as `ast.unparse` writes them, and what Warp is given instead."""

_TABLES: Final = {"models", "discs", "normals", "bounds"}
"""Arrays of two dimensions among the arguments and attributes; all others have one."""

_HEADER: Final = '''
import math
from typing import Any

import warp as wp

Real = wp.{real}


@wp.func
def smaller(a: Real, b: Real):
    return wp.where(b < a, b, a)  # as Python's min, also where one is not a number


@wp.func
def larger(a: Real, b: Real):
    return wp.where(b > a, b, a)


@wp.func
def log1p(x: Real):
    near = Real(1.0) + x  # Kahan: the rounding of this sum cancels
    if near == Real(1.0):
        return x
    return wp.log(near) * (x / (near - Real(1.0)))


@wp.func
def take_rows(arena: wp.array(dtype=Real), rows: int, columns: int):
    """A table of zeros at the end of what is taken."""
    begin = int(arena[0])
    arena[0] = Real(begin + rows * columns)
    room = wp.array(ptr=arena.ptr + wp.uint64({bytes} * begin), shape=(rows, columns), dtype=Real)
    return room


@wp.func
def take(arena: wp.array(dtype=Real), size: int):
    begin = int(arena[0])
    arena[0] = Real(begin + size)
    room = wp.array(ptr=arena.ptr + wp.uint64({bytes} * begin), shape=(size,), dtype=Real)
    return room


@wp.func
def pair(arena: wp.array(dtype=Real), a: Real, b: Real):
    both = take(arena, 2)
    both[0] = a
    both[1] = b
    return both


@wp.func
def head(values: wp.array(dtype=Real), size: int):
    first = wp.array(ptr=values.ptr, shape=(size,), dtype=Real)
    return first


@wp.func
def head_rows(values: wp.array2d(dtype=Real), size: int):
    first = wp.array(ptr=values.ptr, shape=(size, values.shape[1]), dtype=Real)
    return first
'''
_NAMES: Final = {"min": "smaller", "max": "larger", "log1p": "log1p", "copysign": "wp.copysign"}


def arena_size(discs: int, models: int) -> int:
    """Numbers that one decision takes at most: each `np.zeros` of the source, in every call."""
    rows = discs * (models - 1)
    return 1 + 4 * discs + 3 * rows + 14 + 2 * rows + 2 * rows + 3 * 3 * (rows + 4)


def warp_module(root: Function, extra: str, real: str) -> ModuleType:
    """A compiled function and all that it calls, as a module of Warp functions with the same names.

    Args:
        root: Compiled by `compiled`.
        extra: More source, such as kernels, with the names `Real`, `wp` and those of the functions.
        real: ``float32`` or ``float64``.
    """
    parts: dict[str, str] = {}
    unused = set(TRANSLATED)
    _add(root, parts, unused)
    if unused:
        raise ValueError(f"the source no longer has the statements {sorted(unused)}")
    header = _HEADER.format(real=real, bytes=int(real[5:]) // 8)
    name = f"drive_{real}"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{name}.py"  # Warp reads the source of what it compiles
        path.write_text("\n\n".join([header, *parts.values(), extra]))
        spec = importlib.util.spec_from_file_location(name, path)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        spec.loader.exec_module(module)
    return module


def _add(function: Function, parts: dict[str, str], unused: set[str]) -> None:
    plain = getattr(function, "py_func", function)
    if plain.__name__ in parts:
        return
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(plain))).body
    assert isinstance(tree, ast.FunctionDef)
    translation = _Translation(tree, plain.__globals__, parts, unused)
    parts[plain.__name__] = translation.text


def _struct(kind: Any, parts: dict[str, str], names: dict[str, Any]) -> None:
    """A named tuple as a Warp struct, after those that it holds."""
    if kind.__name__ in parts:
        return
    lines = [f"@wp.struct\nclass {kind.__name__}:"]
    for field, held in inspect.get_annotations(kind, eval_str=True).items():
        if hasattr(held, "_fields"):
            _struct(held, parts, names)
        lines.append(f"    {field}: {_type(field, held)}")
    parts[kind.__name__] = "\n".join(lines)


def _type(name: str, kind: Any) -> str:
    if kind is float:
        return "Real"
    if kind in (int, bool) or hasattr(kind, "_fields"):
        return str(kind.__name__)
    return f"wp.array{'2d' if name in _TABLES else ''}(dtype=Real)"


def _is_table(value: ast.expr) -> bool:
    return (
        isinstance(value, ast.Call)
        and ast.unparse(value.func) == "np.zeros"
        and isinstance(value.args[0], ast.Tuple)
    )


class _Translation(ast.NodeTransformer):
    """One function; `text` is the result."""

    def __init__(
        self, tree: ast.FunctionDef, names: dict[str, Any], parts: dict[str, str], unused: set[str]
    ) -> None:
        self._names, self._parts, self._unused = names, parts, unused
        self._kinds = {a.arg: eval(ast.unparse(a.annotation), names) for a in tree.args.args if a.annotation}
        arguments = []
        for name, kind in self._kinds.items():
            if hasattr(kind, "_fields"):
                _struct(kind, parts, names)
            arguments.append(f"{name}: {_type(name, kind)}")
        self._takes, self._tables = False, set[str]()
        lines = ast.unparse(ast.Module(self._block(tree.body), []))
        if self._takes:
            arguments.append("arena: wp.array(dtype=Real)")
        self.text = f"@wp.func\ndef {tree.name}({', '.join(arguments)}):\n{textwrap.indent(lines, '    ')}"

    def _block(self, body: list[ast.stmt]) -> list[ast.stmt]:
        found: list[ast.stmt] = []
        for statement in body:
            new = self.visit(statement)
            found.extend(new if isinstance(new, list) else [new])
        return found

    # Statements ----------------------------------------------------------------------------------------------

    def visit_Expr(self, node: ast.Expr) -> Any:  # noqa: N802
        return [] if isinstance(node.value, ast.Constant) else self.generic_visit(node)  # no docstring

    def visit_Assign(self, node: ast.Assign) -> Any:  # noqa: N802
        (target,), value = node.targets, node.value
        key = ast.unparse(ast.Assign([target], value, lineno=0))
        wanted = key if key in TRANSLATED else f"({ast.unparse(target)[1:-1]})"
        for written, given in TRANSLATED.items():
            if ast.dump(ast.parse(written)) == ast.dump(ast.parse(key)):
                wanted = written
                self._unused.discard(written)
                self._takes = self._takes or "arena" in given
                return ast.parse(textwrap.dedent(given).strip()).body
        del wanted
        if isinstance(value, ast.Subscript) and isinstance(value.value, ast.Call):  # one of several results
            assert isinstance(value.slice, ast.Constant)
            rest = [ast.Name("other", ast.Store()), ast.Name("other", ast.Store())]
            rest[value.slice.value] = target  # type: ignore[call-overload]
            return ast.Assign([ast.Tuple(rest, ast.Store())], self.visit(value.value), lineno=0)  # type: ignore[arg-type]
        if not isinstance(target, ast.Tuple):
            return ast.Assign([target], self._fresh(value), lineno=0)
        if isinstance(value, ast.IfExp):
            assert isinstance(value.body, ast.Tuple) and isinstance(value.orelse, ast.Tuple)
            value = ast.Tuple(
                [ast.IfExp(value.test, a, b) for a, b in zip(value.body.elts, value.orelse.elts, strict=True)]
            )
        if isinstance(value, ast.Name):  # a named tuple, unpacked
            fields = inspect.get_annotations(self._kinds[value.id])
            value = ast.parse(f"({', '.join(f'Real({value.id}.{field})' for field in fields)})").body[0].value  # type: ignore[attr-defined]
            return [ast.Assign([t], v, lineno=0) for t, v in zip(target.elts, value.elts, strict=True)]  # type: ignore[union-attr]
        if isinstance(value, ast.Tuple):
            pairs = list(zip(target.elts, value.elts, strict=True))
            self._tables |= {ast.unparse(t) for t, v in pairs if _is_table(v)}
            return [ast.Assign([t], self._fresh(v), lineno=0) for t, v in pairs]
        return ast.Assign([target], self.visit(value), lineno=0)

    def _fresh(self, value: ast.expr) -> ast.expr:
        """Warp takes a name that is given a constant for a constant, unless the constant is converted."""
        if isinstance(value, ast.Constant) and not isinstance(value.value, float):
            return ast.parse(f"{type(value.value).__name__}({value.value})", mode="eval").body
        return self.visit(value)  # type: ignore[no-any-return]

    def visit_AugAssign(self, node: ast.AugAssign) -> Any:  # noqa: N802
        if not isinstance(node.target, ast.Subscript):
            return self.generic_visit(node)
        now = ast.parse(ast.unparse(node.target), mode="eval").body  # of an array Warp makes an atomic operation
        return ast.Assign([node.target], self.visit(ast.BinOp(now, node.op, node.value)), lineno=0)

    def visit_For(self, node: ast.For) -> Any:  # noqa: N802
        over = node.iter
        if isinstance(over, ast.Name):
            over = ast.Tuple([ast.Constant(v) for v in self._names[over.id]], ast.Load())
        if isinstance(over, ast.Tuple):  # one copy of the body for each
            copies: list[ast.stmt] = []
            for value in over.elts:
                text = ast.unparse(ast.Module([ast.Assign([node.target], value, lineno=0), *node.body], []))
                copies.extend(self._block(ast.parse(text).body))
            return copies
        return ast.For(node.target, self.visit(over), self._block(node.body), [], lineno=0)

    def visit_If(self, node: ast.If) -> Any:  # noqa: N802
        return ast.If(self.visit(node.test), self._block(node.body), self._block(node.orelse))

    # Expressions ---------------------------------------------------------------------------------------------

    def visit_Constant(self, node: ast.Constant) -> Any:  # noqa: N802
        if isinstance(node.value, float):
            return ast.parse(f"Real({_number(node.value)})", mode="eval").body
        return node

    def visit_Name(self, node: ast.Name) -> Any:  # noqa: N802
        value = self._names.get(node.id)
        if isinstance(value, (int, float)) and not isinstance(value, bool) and isinstance(node.ctx, ast.Load):
            return self.visit(ast.Constant(value))
        return node

    def visit_Attribute(self, node: ast.Attribute) -> Any:  # noqa: N802
        name = ast.unparse(node)
        if name in ("math.inf", "math.nan", "math.pi"):
            return self.visit(ast.Constant(getattr(math, node.attr)))
        if node.attr == "size":
            return ast.Call(ast.Name("len", ast.Load()), [node.value], [])
        return self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> Any:  # noqa: N802
        if isinstance(node.op, ast.Pow):
            assert ast.unparse(node.right) == "2"
            return ast.BinOp(self.visit(node.left), ast.Mult(), self.visit(node.left))
        new = self.generic_visit(node)
        assert isinstance(new, ast.BinOp)
        if ast.unparse(new.right) == "body.substeps":  # numbers of two types do not mix
            new.right = ast.Call(ast.Name("Real", ast.Load()), [new.right], [])
        return new

    def visit_Compare(self, node: ast.Compare) -> Any:  # noqa: N802
        terms = [self.visit(term) for term in (node.left, *node.comparators)]
        pairs: list[ast.expr] = [
            ast.Compare(terms[i], [op], [terms[i + 1]]) for i, op in enumerate(node.ops)
        ]
        return pairs[0] if len(pairs) == 1 else ast.BoolOp(ast.And(), pairs)

    def visit_Subscript(self, node: ast.Subscript) -> Any:  # noqa: N802
        if isinstance(node.slice, ast.Slice):
            assert node.slice.lower is None and node.slice.upper is not None
            name = "head_rows" if ast.unparse(node.value) in self._tables else "head"
            return ast.Call(ast.Name(name, ast.Load()), [node.value, self.visit(node.slice.upper)], [])
        return self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> Any:  # noqa: N802
        path = ast.unparse(node.func)
        name = path.rpartition(".")[2]
        arguments: list[ast.expr] = [self.visit(a) for a in node.args]
        if path == "np.zeros":
            self._takes = True
            (shape,) = arguments
            taken = ["take_rows", *map(ast.unparse, shape.elts)] if isinstance(shape, ast.Tuple) else ["take", ast.unparse(shape)]
            return ast.parse(f"{taken[0]}(arena, {', '.join(taken[1:])})", mode="eval").body
        called = self._names.get(name)
        if hasattr(called, "_fields"):
            _struct(called, self._parts, self._names)
        elif inspect.isfunction(getattr(called, "py_func", called)):
            _add(called, self._parts, self._unused)  # type: ignore[arg-type]
            if "arena: " in self._parts[name].splitlines()[1]:
                self._takes = True
                arguments.append(ast.Name("arena", ast.Load()))
        elif name in ("min", "max"):
            while len(arguments) > 1:
                first, second, *others = arguments
                arguments = [ast.Call(ast.Name(_NAMES[name], ast.Load()), [first, second], []), *others]
            return arguments[0]
        function = ast.parse(_NAMES.get(name, path), mode="eval").body
        return ast.Call(function, arguments, [])


def _number(value: float) -> str:
    return repr(value) if math.isfinite(value) else f"math.{value}"
