"""TeleopOperator: a scripted human at the near end of a teleoperation: an arm that feels, and eyes that are late."""

from collections import deque
from typing import Any, Final

import numpy as np

from safe_wrappers.errors import Array

REACTION_S: Final = (0.15, 0.25)
"""Range of human reaction times, s, from which one is drawn."""

_TOUCHED: Final = 1.0  # N, of what is seen: then the operator presses
_RAMP_S: Final = 0.5  # of the pressing force
_PRESSED_S: Final = 1.0  # at the latest the sweep begins
_GAP: Final = 0.03  # m: clearance at which it wants to stop
_MASS: Final = 1.5  # kg, of hand and handle
_DAMPING: Final = 25.0  # N s/m, of the arm
_STEP_S: Final = 0.001  # between two actions


class TeleopOperator:
    """Presses the tool of `TeleopContact-v0` against the wall, sweeps it towards the clamp, and stops before it.

    It sits outside the channel: give it the observations that the channel shows, send the actions that it returns.
    Two things happen at different speeds. The **arm** is a mass and a damper, moved by an intended velocity and an
    intended force, and pushed at once by the force that the handle returns (entries 4 and 5 of the observation):

        mass dv/dt = damping (intended velocity - v) + intended force - returned force

    The hand's velocity v is the action. The **mind** sees the observation one reaction time later, and decides from
    it what to intend: approach until it touches, press with the wanted force, sweep while what it sees as the
    clearance allows.

    A model, not a human: a real one adapts, stiffens and tires, and is not passive without evidence.

    Args:
        seed: Of the reaction time and of the tremor.
        reaction_s: s; None draws one from `REACTION_S`.
        stops: Whether it stops before the clamp. False: it looks away and sweeps on.
        approach_speed: m/s, intended.
        sweep_speed: m/s, intended.
        tremor: Standard deviation of a random force of the arm, N.
    """

    def __init__(
        self,
        seed: int = 0,
        reaction_s: float | None = None,
        stops: bool = True,
        approach_speed: float = 0.1,
        sweep_speed: float = 0.1,
        tremor: float = 0.1,
    ) -> None:
        self._random = np.random.default_rng(seed)
        drawn = float(self._random.uniform(*REACTION_S))
        self.reaction_s = drawn if reaction_s is None else float(reaction_s)
        self._stops = stops
        self._approach_speed, self._sweep_speed, self._tremor = approach_speed, sweep_speed, tremor
        self.reset()

    def reset(self) -> None:
        """A new episode: the hand at rest, nothing seen."""
        self._velocity = [0.0, 0.0]
        self._on_its_way: deque[Any] = deque()
        self.phase = "approach"
        self._steps = 0
        self._since = 0.0

    def act(self, observation: Array) -> Array:
        """The hand's velocity, shape (2,), m/s, within the action space.

        Args:
            observation: As the channel shows it now, shape (9,).
        """
        self._on_its_way.append(observation.tolist())
        if len(self._on_its_way) > 1 + round(self.reaction_s / _STEP_S):
            self._on_its_way.popleft()
        intended, force = self._intention(self._on_its_way[0])
        shake = self._tremor * self._random.standard_normal(2)
        for i in range(2):
            push = _DAMPING * (intended[i] - self._velocity[i]) + force[i] + shake[i]
            rate = (push - float(observation[4 + i])) / _MASS
            self._velocity[i] = min(max(self._velocity[i] + rate * _STEP_S, -1.0), 1.0)
        self._steps += 1
        return np.array(self._velocity)

    def _intention(self, seen: list[float]) -> tuple[tuple[float, float], tuple[float, float]]:
        """Intended velocity and force, from what was shown one reaction time ago."""
        touching, clearance, wanted = seen[6:9]
        now = self._steps * _STEP_S
        if self.phase == "approach":
            if touching < _TOUCHED:
                return (self._approach_speed, 0.0), (0.0, 0.0)
            self.phase, self._since = "press", now
        pressing = wanted * min((now - self._since) / _RAMP_S, 1.0)
        if self.phase == "press":
            if now - self._since < _PRESSED_S:
                return (0.0, 0.0), (pressing, 0.0)
            self.phase = "sweep"
        along = self._sweep_speed
        if self._stops:
            # It comes to a stop over a longer time than what it sees is late by its own reaction.
            along = min(along, max(clearance - _GAP, 0.0) / (4.0 * max(self.reaction_s, 0.1)))
        return (0.0, along), (wanted, 0.0)
