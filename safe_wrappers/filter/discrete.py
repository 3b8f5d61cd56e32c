"""The search for discrete actions, which are whole numbers as floats: every one of them is tried."""

from safe_wrappers.checks import Array
from safe_wrappers.filter.search import Decision, Rows, SafeActionSearch, Stage


class DiscreteSearch(SafeActionSearch):
    """The first candidate that every constraint admits, else what violates least; nothing lies between actions."""

    def _search(self, proposal: Array, strict: Rows, last: Array) -> Decision:
        least = self.least_violation(self._fallback_control(None, last), strict)
        return Decision(least, Stage.LEAST_VIOLATION, fallback=True, infeasible=True)

    def unreadable(self, last: Array) -> Decision:
        """The last action goes on, as there is no zero, unless the fallback is the user's own."""
        if self._fallback.custom:
            return super().unreadable(last)
        return Decision(last, Stage.FALLBACK, fallback=True)
