"""Bad arguments, and the words that say what was expected."""

import math
import re

import numpy as np
import pytest

from safe_wrappers.control.bandwidth import ControlLoop
from safe_wrappers.control.projection import project
from safe_wrappers.control.shapes import convex_outline
from safe_wrappers.control.teleop import ChannelLedger
from safe_wrappers.errors import ConfigurationError

REFUSED = [
    (project, ([np.nan], [[1.0]], [1.0], -1, 1), "u_nom must be finite"),
    (project, ([np.inf], [[1.0]], [1.0], -1, 1), "u_nom must be finite"),
    (project, ([0.0], [[1.0]], [1.0], np.nan, 1.0), "lower must not exceed upper"),
    (project, ([0.0], [[1.0]], [1.0], 1.0, -1.0), "lower must not exceed upper"),
    (project, ([0.0, 0.0], [[1.0, 1.0]], [1.0, 2.0], -1, 1), "expected u_nom (m,)"),
    (project, ([0.0, 0.0, 0.0], np.ones((3, 2)), [1.0, 2.0], -1, 1), "expected u_nom (m,)"),  # transposed
    (project, ([0.0, 0.0], [[1.0, 1.0]], [1.0], [-1.0] * 3, 1), "expected bounds of shape (2,)"),
    (ChannelLedger().add, ([1.0], [1.0], [1.0, 2.0], [1.0], 1.0), "one shape"),
    (ChannelLedger().add, (math.inf, 1.0, 0.0, 0.0, 1.0), "finite"),
    (convex_outline, (np.outer([0.0, 1.0, 2.0], [1.0, 1.0]),), "three points that are not on one line"),
    (ControlLoop(100.0, 60.0).margin_left_deg, (math.pi / 100.0,), "Nyquist"),
    (ControlLoop, (-1.0, 60.0), "crossover"),
    (ControlLoop, (1.0, 180.0), "phase_margin_deg is above 30 degrees, and below 180"),
    (ControlLoop, (1.0, 30.0), "phase_margin_deg is above 30"),
]


@pytest.mark.parametrize(("call", "arguments", "words"), REFUSED)
def test_what_makes_no_sense_is_refused(call, arguments, words):
    with pytest.raises(ConfigurationError, match=re.escape(words)):
        call(*arguments)
