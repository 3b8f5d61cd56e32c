"""Compensated summation (Neumaier): sums over millions of steps are accurate to about one rounding."""


class RunningSum:
    """The sum of a start and the numbers added so far, read as `value`."""

    def __init__(self, start: float = 0.0) -> None:
        self._sum = start
        self._lost = 0.0

    def add(self, value: float) -> None:
        """Add one finite number."""
        total = self._sum + value
        if abs(self._sum) >= abs(value):
            self._lost += (self._sum - total) + value
        else:
            self._lost += (value - total) + self._sum
        self._sum = total

    @property
    def value(self) -> float:
        """The sum."""
        return self._sum + self._lost
