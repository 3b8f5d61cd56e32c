"""Bad arguments, and the words that say what was expected."""

import math
import re

import numpy as np
import pytest

from safe_wrappers.control.bandwidth import ControlLoop
from safe_wrappers.control.contact import friction_pyramid
from safe_wrappers.control.numerics.shapes import convex_outline
from safe_wrappers.control.projection import project
from safe_wrappers.control.teleop import ChannelLedger, to_waves
from safe_wrappers.control.vehicle import slip_window
from safe_wrappers.errors import ConfigurationError

UP, OUTLINE = np.array([0.0, 0.0, 1.0]), "three points that are not on one line"
REFUSED = [
    (project, ([np.nan], [[1.0]], [1.0], -1, 1), "u_nom must be finite"),
    (project, ([np.inf], [[1.0]], [1.0], -1, 1), "u_nom must be finite"),
    (project, ([0.0], [[1.0]], [1.0], np.nan, 1.0), "lower must not exceed upper"),
    (project, ([0.0], [[1.0]], [1.0], 1.0, -1.0), "lower must not exceed upper"),
    (project, ([0.0, 0.0], [[1.0, 1.0]], [1.0, 2.0], -1, 1), "expected u_nom (m,)"),
    (project, ([0.0, 0.0, 0.0], np.ones((3, 2)), [1.0, 2.0], -1, 1), "expected u_nom (m,)"),  # transposed
    (project, ([0.0, 0.0], [[1.0, 1.0]], [1.0], [-1.0] * 3, 1), "expected bounds of shape (2,)"),
    (friction_pyramid, (UP, 0.5, 2), "edges"),
    (slip_window, (1.0, "much", 0.5), "max_slip"),
    (slip_window, (1.0, 0.0, 0.5), "max_slip is a normalised slip ratio in (0, 1)"),
    (slip_window, (1.0, [0.5, 1.0], 0.5), "max_slip is a normalised slip ratio in (0, 1)"),
    (to_waves, (1.0, 1.0, 0.0), "impedance must be a finite number > 0"),
    (to_waves, ([1.0, math.inf], [1.0, 1.0], 1.0), "effort must be finite"),
    (ChannelLedger().add, ([1.0], [1.0], [1.0, 2.0], [1.0], 1.0), "one shape"),
    (ChannelLedger().add, (math.inf, 1.0, 0.0, 0.0, 1.0), "finite"),
    (convex_outline, (np.array([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]]),), OUTLINE),
    (ControlLoop(100.0, 60.0).margin_left_deg, (math.pi / 100.0,), "Nyquist"),
    (ControlLoop, (-1.0, 60.0), "crossover"),
    (ControlLoop, (1.0, 180.0), "phase_margin_deg is below 180 degrees"),
    (ControlLoop, (1.0, 30.0), "above warn_below_deg = 30"),
]


@pytest.mark.parametrize(("call", "arguments", "words"), REFUSED)
def test_what_makes_no_sense_is_refused(call, arguments, words):
    with pytest.raises(ConfigurationError, match=re.escape(words)):
        call(*arguments)
