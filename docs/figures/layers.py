"""The layers of a stack in their legal order, read from stacks that the library has accepted."""

from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

import safe_wrappers as sw
from _style import GRID, INK, OFF, ON, OTHER, SAFE
from safe_wrappers.wrappers import faults

TEXT = {
    "Outages": ("faults", OFF, "lose, delay, repeat commands, to test with", "fault/*"),
    "ChunkHandover": ("", ON, "a late chunk becomes one command per control step", "handover/*"),
    "SafetyOverlay": (
        "",
        GRID,
        "draws what the filter knows into the frames",
        "adds nothing to info",
    ),
    "AdaptionPenalty": ("", OTHER, "a penalty on changed steps, for the learner alone", "adaption/*"),
    "RecordInterventions": ("", GRID, "counts, sums up, writes a CSV file", "interventions/*"),
    "ContactMonitor": (
        "ContactMonitor, BalanceMonitor",
        GRID,
        "measure every physics substep",
        "contact/*, balance/*",
    ),
    "SafeActionMap": ("", ON, "maps the policy's box onto what is admitted", "map/*"),
    "LeaseExpiry": (
        "LeaseExpiry  or  TeleopChannel",
        ON,
        "brakes when a command, or the channel, is too late",
        "lease/*, teleop/*",
    ),
    "CBFActionFilter": ("", ON, "the closest action that every constraint admits", "cbf/*, executed_action"),
    "OcclusionPenalty": ("", OTHER, "estimates what is hidden, for the filter to read", "occlusion/*"),
    "CostFunction": ("", GRID, "judges a task that reports no cost", "cost"),
}
"""By class: what the box says if not the class's name, its colour, what it does, what it adds to info."""
ANY_ORDER = ("SafetyOverlay", "AdaptionPenalty", "RecordInterventions", "ContactMonitor")
REMOTE = ("Outages", "RecordInterventions", "LeaseExpiry", "CBFActionFilter")
"""The layers of `remote`, with the lease in the channel's place."""


def names(env: gym.Env[Any, Any]) -> list[str]:
    """The library's wrappers around an env, the outermost first."""
    found = []
    while isinstance(env, gym.Wrapper):
        if type(env).__module__.startswith("safe_wrappers."):
            found.append(type(env).__name__)
        env = env.env
    return found


def stack() -> list[str]:
    """All layers that go together, in an order that nothing refuses."""
    cars = sw.occlusion.Track(
        "car*", acceleration_noise=[0.03, 0], start_position_std=[0.3, 0], start_velocity_std=[1.2, 0]
    )
    env: Any = sw.CostFunction(
        gym.make("OccludedCrossing-v0", render_mode="rgb_array"),
        lambda task: np.abs(task.data.qvel).max() > 3,
    )
    env = sw.OcclusionPenalty(env, [cars], sensor="eye", tolerance=0.5)
    env = sw.protect(env)
    env = sw.LeaseExpiry(env, sw.StoppingBudget(env.constraints[0], closing_speed=3.0))
    env = sw.SafeActionMap(env)
    env = sw.AdaptionPenalty(sw.RecordInterventions(sw.ContactMonitor(env)), penalty=0.1)
    env = sw.ChunkHandover(sw.SafetyOverlay(env), 16, 8)
    return names(faults.Outages(env, mean_between_s=2.0, mean_length_s=0.5))


def remote() -> list[str]:
    """The same with a network in the lease's place."""
    env = sw.TeleopChannel(sw.protect(gym.make("TeleopContact-v0")), sw.teleop.Link(0.1), sw.teleop.Link(0.1))
    return names(faults.Outages(sw.RecordInterventions(env), mean_between_s=2.0, mean_length_s=0.5))


def box(ax: Axes, y: float, text: str, color: str) -> None:
    """One layer."""
    shape = FancyBboxPatch(
        (0.9, y - 0.33), 4.1, 0.66, boxstyle="round,pad=0,rounding_size=0.12", fc="none", ec=color, lw=1.6
    )
    ax.add_patch(shape)
    ax.text(2.95, y, text, color=INK, weight="bold", ha="center", va="center")


def draw() -> Figure:
    """From the policy to the env; on the right what each layer does, and adds to info."""
    layers = stack()
    assert set(layers) == set(TEXT)
    assert [n.replace("TeleopChannel", "LeaseExpiry") for n in remote()] == [n for n in layers if n in REMOTE]
    figure = Figure(figsize=(7.2, 6.0))
    ax = figure.subplots()
    bottom = -len(layers) - 1
    for k, name in enumerate(layers):
        shown, color, does, says = TEXT[name]
        box(ax, -k - 1, shown or name, color)
        ax.text(5.3, -k - 0.86, does, color=INK, va="center")
        ax.text(5.3, -k - 1.2, says, color=color if color != GRID else INK, va="center", size=8.5, alpha=0.9)
    for y, name in ((0, "policy"), (bottom, "env")):
        box(ax, y, name, SAFE if name == "env" else OFF)
    ax.text(5.3, 0, "gives actions or chunks of them", color=INK, va="center")
    ax.text(5.3, bottom, "executes them; judges the truth: cost, cost_substep", color=INK, va="center")
    arrow = {"arrowstyle": "-|>", "lw": 1.6}
    ax.annotate("", (0.55, bottom), (0.55, 0), arrowprops=arrow | {"color": ON})
    ax.annotate("", (0.15, 0), (0.15, bottom), arrowprops=arrow | {"color": OTHER})
    middle = bottom / 2
    ax.text(0.42, middle, "actions", color=ON, rotation=90, ha="center", va="center")
    ax.text(-0.02, middle, "observation, reward, info", color=OTHER, rotation=90, ha="center", va="center")
    first, last = (layers.index(ANY_ORDER[k]) + 1 for k in (0, -1))
    ax.plot([5.13, 5.13], [-first + 0.33, -last - 0.33], color=GRID, lw=1.2)
    ax.set(xlim=(-0.2, 10.7), ylim=(bottom - 0.5, 0.5))
    ax.axis("off")
    return figure
