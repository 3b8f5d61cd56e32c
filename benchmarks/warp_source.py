"""Compiled functions of the library as functions of NVIDIA Warp: the same source, translated statement by statement.

Warp compiles a smaller Python than Numba: one type of number, no chained comparisons, no short forms for arrays, and
arrays of a size that is known only when a world is looked at have to live in a buffer that the kernel owns (`arena`;
its first number counts what is taken). What no rule knows, Warp refuses.
"""

import ast
import inspect
import math
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

from safe_wrappers.control.backup import drive_decision as among

Function = Callable[..., Any]

ROOTS: Final = (among.closest_admitted, among.manoeuvre_drive)
CONSTANTS: Final[dict[str, dict[str, float]]] = {
    "float64": {},
    "float32": {"ROWS_SLACK": 1e-6},
}
"""What numbers of 32 bits cannot resolve: by how much a projected control may break a row."""
TABLES: Final = frozenset({"models", "discs", "normals", "bounds"})
"""Arguments and attributes that are arrays of two dimensions; all others have one."""

_NAMES: Final = {"min": "smaller", "max": "larger", "log1p": "log1p", "copysign": "wp.copysign"}


@dataclass
class Translator:
    """What is translated so far.

    Attributes:
        tables: Names of arguments and attributes that are arrays of two dimensions; all others have one.
        constants: Values of module constants that replace the source's.
    """

    tables: frozenset[str]
    constants: dict[str, float]

    def __post_init__(self) -> None:
        self.unused = set(self.constants)
        self.parts: dict[str, str] = {}

    def translate(self, roots: Sequence[Function]) -> str:
        """The source of compiled functions, and of all that they call, for Warp.

        Raises:
            ValueError: A constant that the source does not have, or a statement that no rule covers.
        """
        for root in roots:
            self.add(root)
        if self.unused:
            raise ValueError(f"not in the source: {sorted(self.unused)}")
        return "\n\n".join(self.parts.values())

    def add(self, function: Function) -> None:
        """A function, after those that it calls."""
        plain = getattr(function, "py_func", function)
        if plain.__name__ not in self.parts:
            (tree,) = ast.parse(textwrap.dedent(inspect.getsource(plain))).body
            self.parts[plain.__name__] = _Translation(tree, plain.__globals__, self).text

    def add_struct(self, kind: Any) -> None:
        """A named tuple as a Warp struct, after those that it holds."""
        if kind.__name__ in self.parts:
            return
        lines = [f"@wp.struct\nclass {kind.__name__}:"]
        for name, held in inspect.get_annotations(kind, eval_str=True).items():
            if hasattr(held, "_fields"):
                self.add_struct(held)
            lines.append(f"    {name}: {self.type(name, held)}")
        self.parts[kind.__name__] = "\n".join(lines)

    def type(self, name: str, kind: Any) -> str:
        """Warp's type of an argument or attribute."""
        if kind is float:
            return "Real"
        if kind in (int, bool) or hasattr(kind, "_fields"):
            return str(kind.__name__)
        return f"wp.array{'2d' if name in self.tables else ''}(dtype=Real)"


def _is_table(value: ast.expr) -> bool:
    return (
        isinstance(value, ast.Call)
        and ast.unparse(value.func) == "np.zeros"
        and isinstance(value.args[0], ast.Tuple)
    )


class _Translation(ast.NodeTransformer):
    """One function; `text` is the result."""

    def __init__(self, tree: ast.FunctionDef, names: dict[str, Any], job: Translator) -> None:
        self._names, self._job = names, job
        self._kinds = {a.arg: eval(ast.unparse(a.annotation), names) for a in tree.args.args if a.annotation}
        arguments = []
        for name, kind in self._kinds.items():
            if hasattr(kind, "_fields"):
                job.add_struct(kind)
            arguments.append(f"{name}: {job.type(name, kind)}")
        self._takes, self._tables = False, set[str]()
        lines = ast.unparse(self.visit(ast.Module(tree.body, [])))
        if self._takes:
            arguments.append("arena: wp.array(dtype=Real)")
        self.text = f"@wp.func\ndef {tree.name}({', '.join(arguments)}):\n{textwrap.indent(lines, '    ')}"

    # Statements ----------------------------------------------------------------------------------------------

    def visit_Expr(self, node: ast.Expr) -> Any:
        return [] if isinstance(node.value, ast.Constant) else self.generic_visit(node)  # no docstring

    def visit_Assign(self, node: ast.Assign) -> Any:
        (target,), value = node.targets, node.value
        written = ast.unparse(ast.Assign([target], value, lineno=0))
        if isinstance(value, ast.Subscript) and isinstance(value.value, ast.Call):  # one of several results
            assert isinstance(value.slice, ast.Constant)
            rest = [ast.Name("other", ast.Store()), ast.Name("other", ast.Store())]
            rest[value.slice.value] = target
            return ast.Assign([ast.Tuple(rest, ast.Store())], self.visit(value.value), lineno=0)
        if not isinstance(target, ast.Tuple):
            return ast.Assign([target], self._fresh(value), lineno=0)
        if isinstance(value, ast.IfExp):
            assert isinstance(value.body, ast.Tuple) and isinstance(value.orelse, ast.Tuple)
            value = ast.Tuple(
                [ast.IfExp(value.test, a, b) for a, b in zip(value.body.elts, value.orelse.elts, strict=True)]
            )
        if isinstance(value, ast.Name):  # a named tuple, unpacked
            fields = inspect.get_annotations(self._kinds[value.id])
            value = ast.parse(f"({', '.join(f'Real({value.id}.{field})' for field in fields)})").body[0].value
            return [ast.Assign([t], v, lineno=0) for t, v in zip(target.elts, value.elts, strict=True)]
        if isinstance(value, ast.Tuple):
            pairs = list(zip(target.elts, value.elts, strict=True))
            for i, (_, later) in enumerate(pairs):  # one after the other is the same only then
                read = {n.id for n in ast.walk(later) if isinstance(n, ast.Name)}
                if read & {ast.unparse(t) for t, _ in pairs[:i]}:
                    raise ValueError(f"no rule for {written}")
            self._tables |= {ast.unparse(t) for t, v in pairs if _is_table(v)}
            return [ast.Assign([t], self._fresh(v), lineno=0) for t, v in pairs]
        return ast.Assign([target], self.visit(value), lineno=0)

    def _fresh(self, value: ast.expr) -> ast.expr:
        """Warp takes a name that is given a constant for a constant, unless the constant is converted."""
        if isinstance(value, ast.Constant) and not isinstance(value.value, float):
            return ast.parse(f"{type(value.value).__name__}({value.value})", mode="eval").body
        return self.visit(value)

    def visit_AugAssign(self, node: ast.AugAssign) -> Any:
        if not isinstance(node.target, ast.Subscript):
            return self.generic_visit(node)
        # Of an array Warp makes an atomic operation.
        now = ast.parse(ast.unparse(node.target), mode="eval").body
        return ast.Assign([node.target], self.visit(ast.BinOp(now, node.op, node.value)), lineno=0)

    def visit_For(self, node: ast.For) -> Any:
        over = node.iter
        if isinstance(over, ast.Name):
            over = ast.Tuple([ast.Constant(v) for v in self._names[over.id]], ast.Load())
        if isinstance(over, ast.Tuple):  # one copy of the body for each
            copies: list[ast.stmt] = []
            for value in over.elts:
                text = ast.unparse(ast.Module([ast.Assign([node.target], value, lineno=0), *node.body], []))
                copies.extend(self.visit(ast.parse(text)).body)
            return copies
        return self.generic_visit(node)

    # Expressions ---------------------------------------------------------------------------------------------

    def visit_Constant(self, node: ast.Constant) -> Any:
        if isinstance(node.value, float):
            return ast.parse(f"Real({_number(node.value)})", mode="eval").body
        return node

    def visit_Name(self, node: ast.Name) -> Any:
        value = self._names.get(node.id)
        if node.id in self._job.constants:
            self._job.unused.discard(node.id)
            value = self._job.constants[node.id]
        if isinstance(value, (int, float)) and not isinstance(value, bool) and isinstance(node.ctx, ast.Load):
            return self.visit(ast.Constant(value))
        return node

    def visit_Attribute(self, node: ast.Attribute) -> Any:
        name = ast.unparse(node)
        if name in ("math.inf", "math.nan", "math.pi"):
            return self.visit(ast.Constant(getattr(math, node.attr)))
        if node.attr == "size":
            return ast.Call(ast.Name("len", ast.Load()), [node.value], [])
        return self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> Any:
        if isinstance(node.op, ast.Pow):
            assert ast.unparse(node.right) == "2"
            return ast.BinOp(self.visit(node.left), ast.Mult(), self.visit(node.left))
        new = self.generic_visit(node)
        assert isinstance(new, ast.BinOp)
        if ast.unparse(new.right).endswith(".substeps"):  # numbers of two types do not mix
            new.right = ast.Call(ast.Name("Real", ast.Load()), [new.right], [])
        return new

    def visit_Compare(self, node: ast.Compare) -> Any:
        terms = [self.visit(term) for term in (node.left, *node.comparators)]
        pairs: list[ast.expr] = [ast.Compare(terms[i], [op], [terms[i + 1]]) for i, op in enumerate(node.ops)]
        return pairs[0] if len(pairs) == 1 else ast.BoolOp(ast.And(), pairs)

    def visit_Subscript(self, node: ast.Subscript) -> Any:
        if isinstance(node.slice, ast.Slice):
            assert node.slice.lower is None and node.slice.upper is not None
            name = "head_rows" if ast.unparse(node.value) in self._tables else "head"
            return ast.Call(ast.Name(name, ast.Load()), [node.value, self.visit(node.slice.upper)], [])
        return self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> Any:
        path = ast.unparse(node.func)
        name = path.rpartition(".")[2]
        arguments: list[ast.expr] = [self.visit(a) for a in node.args]
        if path == "np.zeros":
            self._takes = True
            (shape,) = arguments
            taken = (
                ["take_rows", *map(ast.unparse, shape.elts)]
                if isinstance(shape, ast.Tuple)
                else ["take", ast.unparse(shape)]
            )
            return ast.parse(f"{taken[0]}(arena, {', '.join(taken[1:])})", mode="eval").body
        called = self._names.get(name)
        if hasattr(called, "_fields"):
            self._job.add_struct(called)
        elif inspect.isfunction(getattr(called, "py_func", called)):
            self._job.add(called)
            if "arena: " in self._job.parts[name].splitlines()[1]:
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
