"""FrozenPolicy: for a while the policy sends the same command again and again."""

from safe_wrappers.wrappers.faults.fault import Carried
from safe_wrappers.wrappers.faults.spells import SpellFault


class FrozenPolicy(SpellFault):
    """Repeats, during spells of random length, the last command from before: a heartbeat with nobody behind it.

    Its stamp stays the old one: a command is as old as what it was made from, however often it is sent.

    Args:
        env: See `Fault`.
        mean_between_s: Mean time from the end of a spell to the start of the next, s.
        mean_length_s: Mean length of a spell, s.
        hold_s: See `Fault`.
    """

    def begin(self) -> None:
        """An episode begins alive."""
        super().begin()
        self._frozen: Carried | None = None

    def carry(self, given: Carried | None, now_s: float) -> Carried | None:
        """The command, or the one from before the spell."""
        if self.bad(now_s):
            return self._frozen
        self._frozen = given if given is not None else self._frozen
        return given
