"""Hypothesis draws the same examples in every run; `make fuzz` draws others."""

from hypothesis import HealthCheck, settings

# The newcomer's command must not depend on luck. No time limits: machines differ, are busy, and may stall.
TIMELESS = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow]}
settings.register_profile("reproducible", derandomize=True, database=None, **TIMELESS)
# Said outright, as hypothesis itself draws the same in every run where it finds a CI server.
settings.register_profile("fuzz", derandomize=False, print_blob=True, **TIMELESS)
settings.load_profile("reproducible")

BEGIN = (
    # Each worker compiles other parts of the package first and finds those of the other one compiled.
    "test_active_set",
    "test_drive_among_discs",
    "test_point_decision",
    "test_support_distances",
    "test_way_clearances",
    "test_contact_feasibility",
    # What takes long comes early, so that no worker is alone with it in the end.
    "test_cli",
    "test_golden_traces",
    "test_wrapper_contract",
    "test_protect",
    "test_vector_cbf_action_filter",
    "test_pictures",
    "test_report",
    "test_parallel",
    "test_pages",
    "test_rendering",
)
"""Files in the order in which parallel workers begin them; the others follow."""


def pytest_collection_modifyitems(config, items: list) -> None:
    if hasattr(config, "workerinput"):
        places = {name: place for place, name in enumerate(BEGIN)}
        items.sort(key=lambda item: places.get(item.path.stem, len(places)))
