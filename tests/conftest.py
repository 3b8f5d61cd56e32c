"""Hypothesis draws the same examples in every run; `make fuzz` draws others."""

from hypothesis import settings

# The newcomer's command must not depend on luck. No time limit per example: machines differ, and are busy.
settings.register_profile("reproducible", derandomize=True, database=None, deadline=None)
# Said outright, as hypothesis itself draws the same in every run where it finds a CI server.
settings.register_profile("fuzz", derandomize=False, deadline=None, print_blob=True)
settings.load_profile("reproducible")
