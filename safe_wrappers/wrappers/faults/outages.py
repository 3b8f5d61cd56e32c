"""Outages: for a while no command arrives at all."""

from safe_wrappers.wrappers.faults.fault import Carried
from safe_wrappers.wrappers.faults.spells import SpellFault


class Outages(SpellFault):
    """Loses all commands during outages of random length, at random times.

    Args:
        env: See `Fault`.
        mean_between_s: Mean time from the end of an outage to the start of the next, s.
        mean_length_s: Mean length of an outage, s.
        hold_s: See `Fault`.
    """

    def carry(self, given: Carried | None, now_s: float) -> Carried | None:
        """The command, or nothing."""
        return None if self.bad(now_s) else given
