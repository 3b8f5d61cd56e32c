"""MuJoCo's enums are compared as integers: from 3.12 on `enum == numpy.int32(...)` is False, and `in` asks so."""

import ast
import re
from pathlib import Path

import pytest

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


@pytest.mark.parametrize(
    "code",
    [
        "found = m.jnt_type[j] in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL)",
        "assert mujoco.mjtTrn.mjTRN_SITE == m.actuator_trntype[0]",
        "def scalar(m):\n    kinds = {mujoco.mjtJoint.mjJNT_HINGE}\n    return m.jnt_type[0] in kinds",
    ],
)
def test_what_is_looked_for_is_found(code):
    assert list(compared(code)) and not list(compared(re.sub(r"(mujoco[\w.]+)", r"int(\1)", code)))


def test_no_enum_is_compared_as_it_is():
    assert len(FILES) > 100
    found = {str(path): list(compared(path.read_text(encoding="utf-8"))) for path in FILES}
    assert not any(found.values()), f"write int(...) around {found}"
