"""MuJoCo's enums are compared as integers: from 3.12 on `enum == numpy.int32(...)` is False, and `in` asks so."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
FILES = [path for folder in ("safe_wrappers", "envs", "train") for path in (ROOT / folder).rglob("*.py")]


def compared(text):
    """Comparisons, and tuples and sets that are kept to be searched in, with a member as it is."""
    for node in ast.walk(ast.parse(text if "mjt" in text else "")):
        kept = isinstance(node, ast.Assign) and isinstance(node.value, ast.Set | ast.Tuple)
        if kept or isinstance(node, ast.Compare):
            left, calls = ast.unparse(node), 1
            while calls:  # what a function (an `int`) is called with is no member as it is
                left, calls = re.subn(r"\w+\([^()]*\)", "", left)
            if re.search(r"\bmjt\w+\.mj", left):
                yield ast.unparse(node)


def test_no_enum_is_compared_as_it_is():
    for wrong in ("kind = t[0] in (mujoco.mjtJoint.mjJNT_FREE, 3)", "kinds = {mujoco.mjtJoint.mjJNT_HINGE}"):
        assert list(compared(wrong)) and not list(compared(re.sub(r"(mujoco[\w.]+)", r"int(\1)", wrong)))
    assert len(FILES) > 100
    found = {str(path): list(compared(path.read_text(encoding="utf-8"))) for path in FILES}
    assert not any(found.values()), f"write int(...) around {found}"
