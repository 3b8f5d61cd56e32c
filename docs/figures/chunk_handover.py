"""The seam between two chunks on an arm with elastic joints: put in place at once, and blended."""

from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import safe_wrappers as sw
from _style import GRID, OFF, ON, panels

STEP_S = 0.01
CHUNK, HORIZON, DELAY = 32, 16, 2
SHOWN = (0.3, 0.7)
"""s; the seams of three chunks."""


class Log(gym.Wrapper[Any, Any, Any, Any]):
    """Keeps every command that the robot gets, and what the joints do."""

    def reset(self, **arguments: Any) -> Any:
        """A new episode."""
        self.commands: list[NDArray[Any]] = []
        self.energy: list[float] = []
        return self.env.reset(**arguments)

    def step(self, action: Any) -> Any:
        """One control step."""
        stepped = self.env.step(action)
        self.commands.append(np.array(action))
        self.energy.append(stepped[4]["vibration_energy"])
        return stepped


def chunk(number: int, rng: np.random.Generator) -> NDArray[Any]:
    """A slow swing that everybody agrees on, and an offset of each chunk's own: policies change their minds."""
    time = STEP_S * (number * HORIZON + np.arange(CHUNK))
    swing = np.stack([np.sin(5.0 * time), 0.3 * np.cos(5.0 * time)], axis=1)
    return (swing + rng.uniform([-0.9, -0.3], [0.9, 0.3])).astype(np.float32)


def run(**bounds: float) -> Log:
    """The same chunks with another seam."""
    log = Log(gym.make("FlexJointReach-v0"))
    env = sw.ChunkHandover(log, CHUNK, HORIZON, inference_delay=DELAY, **bounds)
    env.reset(seed=0)
    rng = np.random.default_rng(1)
    for number in range(12):
        env.step(chunk(number, rng))
    return log


def draw() -> Figure:
    """Command, its first difference, and the energy that the seam leaves in the springs."""
    figure, (command, rate, energy) = panels(3, height=2.7)
    for bounds, color, name in (
        ({"rate_limit": 1e9}, OFF, "replaced"),
        ({"blend_time": 0.15}, ON, "blended"),
    ):
        log = run(**bounds)
        time = STEP_S * np.arange(len(log.commands))
        torque = np.array(log.commands)[:, 0]
        command.step(time, torque, where="post", color=color, label=name)
        rate.step(time, np.diff(torque, prepend=torque[0]), where="mid", color=color)
        energy.plot(time, 1e3 * np.array(log.energy), color=color)
    for ax in (command, rate, energy):
        ax.set_xlim(*SHOWN)
        ax.set_xlabel("time (s)")
        for number in range(12):
            ax.axvline(STEP_S * (number * HORIZON + DELAY), color=GRID, lw=0.8, ls=":")
    command.set_title("shoulder torque (N m)")
    rate.set_title("first difference")
    energy.set_title("vibration (mJ)")
    command.legend(loc="lower left")
    energy.set_ylim(0.0, 5.0)
    return figure
