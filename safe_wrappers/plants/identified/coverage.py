"""Bounds on the next score from n scores that are exchangeable with it, and whether they hold in closed loop.

Source: Vovk, Gammerman and Shafer, *Algorithmic Learning in a Random World*, 2005 (split conformal prediction); the
finite-sample rank as in Lei et al., *Distribution-Free Predictive Inference for Regression*, JASA 2018.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

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


_ALTERNATIVES = 20
_ALARM = np.log(1000.0)


class Coverage:
    """Counts an episode's misses, and says when they are too many for a conformal bound.

    A test martingale: the likelihood of the misses under larger miss rates, over that under exchangeability with the
    scores that the bound came from. It passes 1,000 with a probability of at most 0.1 % in an episode whose steps are
    exchangeable with these, however long it is and however often one looks (Ville's inequality). A quantile of the
    binomial distribution would be right for one look alone, and for a bound from infinitely many scores.

    The steps of one episode are often alike, however: a gust lasts. So the alarm is also above what n known episodes
    have reached, which another one like them passes with a probability of about 1 / (n + 1), whatever binds their
    steps.

    Args:
        scores: From how many scores the bound came.
        miss_rate: For which it was made.

    Attributes:
        judged: Steps judged so far.
        missed: Those of them in which the bound did not hold.
        lost: The misses were too many, now or earlier in the episode.
    """

    def __init__(self, scores: int, miss_rate: float) -> None:
        allowed = allowed_misses(scores, miss_rate)
        # Given the scores, the miss rate is drawn from Beta(allowed, scores + 1 - allowed).
        self._misses, self._others = allowed, scores + 1 - allowed
        steps = (np.arange(_ALTERNATIVES) + 0.5) / _ALTERNATIVES
        self._larger = miss_rate + (1.0 - miss_rate) * steps
        self.set_alarm([])
        self.start()

    def set_alarm(self, known: Sequence[NDArray[np.bool_]]) -> None:
        """Above what known episodes have reached: of each, whether the bound held after each step."""
        reached = [self.evidence(np.cumsum(~held), np.arange(1, len(held) + 1)).max() for held in known]
        self._alarm = max([_ALARM, *reached])

    def start(self) -> None:
        """A new episode."""
        self.judged = self.missed = 0
        self.lost = False

    def judge(self, held: bool) -> None:
        """Count a step."""
        self.judged += 1
        self.missed += not held
        self.lost |= bool(self.evidence(self.missed, self.judged) > self._alarm)

    def evidence(self, missed: ArrayLike, judged: ArrayLike) -> Array:
        """The logarithm of the martingale after so many steps, shape of the arguments."""
        from scipy.special import betaln  # here: it takes a sixth of the time of `import safe_wrappers`

        missed = np.asarray(missed, dtype=np.float64)
        kept = np.asarray(judged, dtype=np.float64) - missed
        larger = missed[..., None] * np.log(self._larger) + kept[..., None] * np.log1p(-self._larger)
        declared = betaln(self._misses + missed, self._others + kept) - betaln(self._misses, self._others)
        return np.asarray(np.logaddexp.reduce(larger, axis=-1) - np.log(_ALTERNATIVES) - declared)
