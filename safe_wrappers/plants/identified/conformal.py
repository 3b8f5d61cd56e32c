"""Split conformal prediction: a bound on the next score from n scores that are exchangeable with it.

Source: Vovk, Gammerman and Shafer, *Algorithmic Learning in a Random World*, 2005; the finite-sample rank as in Lei
et al., *Distribution-Free Predictive Inference for Regression*, JASA 2018.
"""

import math

import numpy as np

from safe_wrappers.checks import Array

_ROUNDING = 1e-9  # (9 + 1) * 0.1 is a whole number, and so is what its rounding makes of it


def scores_needed(miss_rate: float) -> int:
    """The fewest scores from which a finite bound with this miss rate follows."""
    return math.ceil(1.0 / miss_rate - 1.0 - _ROUNDING)


def allowed_misses(scores: int, miss_rate: float) -> int:
    """l: how many of n scores, and the next one, may be above the bound; 0: there is no finite bound.

    Given the scores, the probability that the next one is above has the distribution Beta(l, n + 1 - l), if scores
    are continuous; its mean l / (n + 1) is at most the miss rate.
    """
    return math.floor((scores + 1) * miss_rate + _ROUNDING)


def upper_bound(scores: Array, miss_rate: float) -> float:
    """What the next score exceeds with a probability of at most `miss_rate`.

    It is the ceil((n + 1)(1 - miss_rate))-th smallest score.

    Args:
        scores: Shape (n,), exchangeable with the next one; NaN counts as infinite.
        miss_rate: Between 0 and 1.

    Returns:
        inf where n is less than `scores_needed`, or too many scores are infinite.
    """
    rank = len(scores) + 1 - allowed_misses(len(scores), miss_rate)
    if rank > len(scores):
        return math.inf
    return float(np.sort(np.where(np.isnan(scores), np.inf, scores))[rank - 1])
