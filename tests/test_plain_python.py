"""What is compiled gives the same bits in plain Python, over all that the tests named here go through."""

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from safe_wrappers.control.compiled import IS_COMPILED

FOLDERS = [str(Path(__file__).parent / name) for name in ("control", "constraints", "plants")]
CALLS = {
    "test_shapes": ("random_looks", [200]),
    "test_heading_drive": ("random_scenes", [10]),
    "test_point_among_walls": ("random_scenes", [40]),
}
"""Module -> its function that returns a digest, and the arguments."""


def found(module):
    name, arguments = CALLS[module]
    return json.loads(json.dumps(getattr(importlib.import_module(module), name)(*arguments)))


@pytest.fixture(scope="module")
def in_plain_python():
    code = "import json, test_plain_python as t; print(json.dumps([t.IS_COMPILED, {m: t.found(m) for m in t.CALLS}]))"
    path = os.pathsep.join([str(Path(__file__).parent), *FOLDERS, *sys.path])
    environment = os.environ | {"SAFE_WRAPPERS_COMPILED": "0", "PYTHONPATH": path}
    said = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    compiled, digests = json.loads(said.stdout.splitlines()[-1])
    assert not compiled
    return digests


@pytest.mark.parametrize("module", CALLS)
def test_plain_python_gives_the_same_bits(module, in_plain_python, monkeypatch):
    assert IS_COMPILED or os.environ.get("SAFE_WRAPPERS_COMPILED") == "0"
    for folder in FOLDERS:
        monkeypatch.syspath_prepend(folder)
    assert found(module) == in_plain_python[module]
