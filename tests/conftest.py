"""Hypothesis draws the same examples in every run; `make fuzz` draws others."""

from hypothesis import HealthCheck, settings

# The newcomer's command must not depend on luck. No time limits: machines differ, are busy, and may stall.
TIMELESS = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow]}
settings.register_profile("reproducible", derandomize=True, database=None, **TIMELESS)
# Said outright, as hypothesis itself draws the same in every run where it finds a CI server.
settings.register_profile("fuzz", derandomize=False, print_blob=True, **TIMELESS)
settings.load_profile("reproducible")
