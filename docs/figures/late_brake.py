"""How much of an impact's peak force a brake takes off that acts some time after the first touch."""

import numpy as np
from matplotlib.figure import Figure

from _style import FORBIDDEN, OFF, ON, OTHER, panels
from safe_wrappers.control.contact.impact import attenuation_after_delay, time_to_peak

MASS, STIFFNESS, SPEED = 6.0, 25e3, 0.7


def draw() -> Figure:
    """The peak that is left, against the brake's latency."""
    figure, ax = panels(height=2.6, width=5.4)
    peak_s = float(time_to_peak(MASS, STIFFNESS))
    latency = np.linspace(0.0, 1.6 * peak_s, 200)
    for braking, color in ((5.0, ON), (20.0, OTHER), (80.0, OFF)):
        left = 1.0 - attenuation_after_delay(SPEED, MASS, STIFFNESS, braking, latency)
        assert (left[latency >= peak_s] == 1.0).all()  # what the caption says
        ax.plot(1e3 * latency, 100.0 * left, color=color, label=f"{braking:g} m/s²")
    ax.axvline(1e3 * peak_s, color=FORBIDDEN, lw=1.2)
    ax.annotate("time to peak", (1e3 * peak_s, 25.0), (4, 0), textcoords="offset points", color=FORBIDDEN)
    ax.set(ylim=(0.0, 110.0), xlabel="from the first touch to the brake's action (ms)")
    ax.set_ylabel("peak force left (%)")
    ax.legend(loc="lower right", title="deceleration")
    return figure
