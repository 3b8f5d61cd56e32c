"""Hypothesis draws the same examples in every run; `make fuzz` draws others."""

import gc
import os
import subprocess
import sys

import pytest
from hypothesis import HealthCheck, settings

# The newcomer's command must not depend on luck. No time limits: machines differ, are busy, and may stall.
TIMELESS = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow]}
# A test says how many examples only where one takes long: the same fifty in every run find what changed, and where
# they are drawn anew there can be more.
settings.register_profile("reproducible", derandomize=True, database=None, max_examples=50, **TIMELESS)
# Said outright, as hypothesis itself draws the same in every run where it finds a CI server.
settings.register_profile("fuzz", derandomize=False, print_blob=True, max_examples=200, **TIMELESS)
settings.load_profile("reproducible")

BEGIN = (
    # Each worker compiles other parts of the package first and finds those of the other one compiled.
    "test_heading_drive",
    "test_point_among_walls",
    "test_contact",
    "test_contact_feasibility",
    # What takes long comes early, so that no worker is alone with it in the end.
    "test_cli",
    "test_golden_traces",
    "test_wrapper_contract",
    "test_protect",
    "test_vector_cbf_action_filter",
    "test_algorithms",
    "test_run",
    "test_pages",
    "test_videos",
)
"""Files in the order in which parallel workers begin them; the others follow."""


@pytest.fixture(scope="session")
def gl() -> dict[str, str]:
    """Environment variables with which another process draws frames here; this one may have been told not to."""
    draw = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 32, 32).render()"
    for choice in ("egl", "osmesa"):
        environ = {**os.environ, "MUJOCO_GL": choice}
        done = subprocess.run([sys.executable, "-c", draw], env=environ, capture_output=True, timeout=120)
        if done.returncode == 0:
            return environ
    pytest.skip("neither EGL nor OSMesa draws a frame here (apt install libosmesa6)")


def pytest_collection_finish() -> None:
    """What the imports have made is never garbage: no collection need look at its many objects again."""
    gc.collect()
    gc.freeze()


def pytest_collection_modifyitems(config, items: list) -> None:
    if hasattr(config, "workerinput"):
        places = {name: place for place, name in enumerate(BEGIN)}
        items.sort(key=lambda item: places.get(item.path.stem, len(places)))
