"""What a plain delay makes of a sine, by phase and by what is behind it; and what lossy lines put out."""

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from _style import FORBIDDEN, GRID, INK, OFF, ON, OTHER, panels
from safe_wrappers.control.teleop.passivity import ChannelLedger
from safe_wrappers.control.teleop.wave_line import WaveLine

TICKS = 48
"""Per period."""
TICK_S = 1e-3
PACKETS = 600


def draw() -> Figure:
    """Left: mean power of a plain channel. Right: energy out of a line against what has arrived."""
    figure, (left, right) = panels(2, height=3.2)
    _phases(left)
    _lines(right)
    return figure


def _phases(ax: Axes) -> None:
    delays = np.arange(0, TICKS // 2 + 1)
    degrees = 360.0 * delays / TICKS
    for name, impedance, color in (("spring", -1j, OFF), ("mass", 1j, OTHER), ("damper", 1.0, FORBIDDEN)):
        ax.plot(degrees, [_made(int(d), impedance) for d in delays], color=color, label=name)
    for impedance, label in ((-1j, "any, with waves"), (1j, None), (1.0, None)):
        ax.plot(degrees, [_made_of_waves(int(d), impedance) for d in delays], color=ON, label=label)
    ax.set(xticks=[0, 45, 90, 135, 180], xlabel="phase of the delay, one way (degrees)")
    ax.set(ylabel="mean power it makes", yticks=[0], ylim=(-0.62, 1.65))
    ax.text(90.0, -0.45, "passive", ha="center", color=INK)
    ax.text(2.0, 0.75, "active", color=INK)
    ax.legend(loc="upper left", ncols=2, fontsize=8)


def _made(delay: int, impedance: complex) -> float:
    """Over one settled period: flow goes there late, the effort of what is behind comes back late."""
    ledger, step = ChannelLedger(), 2.0 * math.pi / TICKS
    for n in range(TICKS):
        there, back = n - delay, n - 2 * delay
        effort_s = (impedance * np.exp(1j * step * there)).real
        effort_m = (impedance * np.exp(1j * step * back)).real
        ledger.add(effort_m, math.cos(step * n), effort_s, math.cos(step * there), 1.0 / TICKS)
    return -ledger.net_j


def _made_of_waves(delay: int, impedance: complex) -> float:
    """The same with waves in the channel, of impedance 1: what is behind it answers one with a part of it."""
    ledger, step = ChannelLedger(), 2.0 * math.pi / TICKS
    answer = (impedance - 1.0) / (impedance + 1.0)

    for n in range(TICKS):
        here, there, back = (np.exp(1j * step * (n - late)) for late in (0, delay, 2 * delay))
        u_m, w_m, u_s, w_s = here.real, (answer * back).real, there.real, (answer * there).real
        effort_m, flow_m = math.sqrt(0.5) * (u_m + w_m), math.sqrt(0.5) * (u_m - w_m)
        effort_s, flow_s = math.sqrt(0.5) * (u_s + w_s), math.sqrt(0.5) * (u_s - w_s)
        ledger.add(effort_m, flow_m, effort_s, flow_s, 1.0 / TICKS)
    return -ledger.net_j


def _lines(ax: Axes) -> None:
    rng = np.random.default_rng(3)
    waves = 1.0 + 0.5 * np.sin(np.arange(PACKETS) * 2.0 * math.pi / 300.0)
    due: list[list[int]] = [[] for _ in range(PACKETS + 60)]
    for k in range(PACKETS):
        if rng.random() > 0.3:
            due[k + 20 + int(rng.integers(0, 20))].append(k)
    times = 1e3 * TICK_S * np.arange(PACKETS)
    energy = 0.5 * TICK_S * waves**2
    arrived = np.cumsum([sum(energy[k] for k in due[tick]) for tick in range(PACKETS)])
    ax.plot(times, 1e3 * arrived, color=INK, lw=4.0, alpha=0.35, label="arrived")
    newest, repeated = -1, np.zeros(PACKETS)
    for tick in range(PACKETS):
        newest = max([newest, *due[tick]])
        repeated[tick] = energy[newest] if newest >= 0 else 0.0
    ax.plot(times, 1e3 * np.cumsum(repeated), color=FORBIDDEN, label="last one repeated")
    line, out = WaveLine(TICK_S), []
    for tick in range(PACKETS):
        line.send(waves[tick], tick)
        line.deliver([(k, waves[k]) for k in due[tick]])
        out.append(line.put_out_j)
    ax.plot(times, 1e3 * np.array(out), color=ON, lw=1.2, label="a wave line")
    ax.grid(axis="y", lw=0.4, color=GRID)
    ax.set(xlabel="time (ms)", ylabel="energy put out (mJ)")
    ax.legend(loc="upper left", fontsize=8)
