"""NOT_JUDGED: what stands in info for a number that nobody reported."""

import math
from typing import Any, Final

import numpy as np


class _NotJudged(np.float64):
    """A NaN that equals every NaN: Gymnasium's `check_env` compares the infos of two equal runs by `==`."""

    def __eq__(self, other: Any) -> bool:
        return isinstance(other, float) and math.isnan(other)

    def __ne__(self, other: Any) -> bool:
        return not self == other

    def __hash__(self) -> int:
        return hash(type(self))

    def __reduce__(self) -> str:
        return "NOT_JUDGED"  # the one below, in a copy and in another process too


NOT_JUDGED: Final = _NotJudged("nan")
"""float64 NaN; ask for it with `math.isnan`."""
