"""A rollout's measure at MuJoCo's physics substeps, which lie between the steps that an env returns."""

import contextlib
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np

from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.mujoco.binding import physics_steps
from safe_wrappers.plants.rollouts import Measure, View
from safe_wrappers.plants.simulator.replay_check import differing

_INSTEAD = '(h may read env.data, with sees="env")'


def known_substeps(raw: Any) -> int:
    """How many physics substeps an unwrapped env is known to take with one action."""
    try:
        return physics_steps(raw) if isinstance(getattr(raw, "model", None), mujoco.MjModel) else 1
    except ConfigurationError:  # it does not say
        return 1


class Substeps:
    """Measures a rollout at MuJoCo's substeps.

    Attributes:
        why_not: Why they cannot be measured, once that is known.
    """

    def __init__(self, measure: Measure | None, sees: str) -> None:
        self._measure, self._sees, self._values, self.why_not = measure, sees, list[float](), ""

    @contextlib.contextmanager
    def of(self, raw: Any) -> Iterator[None]:
        """Let an env simulate substep by substep, which MuJoCo makes the same of, bit for bit."""
        if not self._sees:
            yield
            return
        simulate = raw._step_mujoco_simulation

        def one_by_one(ctrl: Any, n_frames: int) -> None:
            for _ in range(n_frames):
                simulate(ctrl, 1)
                self._look(raw)

        raw._step_mujoco_simulation = one_by_one
        try:
            yield
        finally:
            del raw._step_mujoco_simulation

    def _look(self, raw: Any) -> None:
        assert self._measure is not None
        if self._sees != "env" and not hasattr(raw, "_get_obs"):
            self.why_not = f"this env has no _get_obs() {_INSTEAD}"
        if self.why_not:
            return
        try:
            observation = None if self._sees == "env" else raw._get_obs()
            self._values.append(self._measure(View(raw, observation, {})))
        except KeyError as missing:
            self.why_not = f"h reads {missing} of info, which only a whole step has"

    def least(self, value: float, view: View) -> float:
        """The least of the step that has just ended, with the value at its end."""
        values, self._values = self._values, []
        if values and self._sees != "env" and differing("", view.env._get_obs(), view.observation):
            self.why_not = (
                f"a wrapper inside the filter changes the observation, or it is not the same twice {_INSTEAD}"
            )
        return float(np.min([*values, value]))
