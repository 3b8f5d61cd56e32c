"""Random walks on a frozen lake, shielded and not."""

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

import safe_wrappers as sw
from _style import FORBIDDEN, GRID, OFF, ON, SAFE, bare, panels

WALKS, STEPS = 12, 60


def on_ice(env: gym.Env) -> float:
    """Negative in a hole."""
    row, column = divmod(int(env.s), env.ncol)
    return -1.0 if env.desc[row, column] == b"H" else 1.0


def draw() -> Figure:
    """A map without the shield, and one with it."""
    figure, axes = panels(2, height=3.4)
    for ax, shielded in zip(axes, (False, True), strict=True):
        lake = gym.make("FrozenLake-v1", map_name="8x8", is_slippery=False)
        shield = sw.constraints.PredictiveShield(on_ice, horizon=2, backup=[0, 1, 2, 3], sees="env")
        env = (
            sw.ActionShield(lake, [shield], plant=sw.SimulatorPlant(control_dt=1.0, check_steps=20))
            if shielded
            else lake
        )
        for row, column in np.ndindex(8, 8):
            kind = lake.unwrapped.desc[row, column]
            color = {b"H": FORBIDDEN, b"G": SAFE}.get(kind)
            ax.add_patch(
                Rectangle(
                    (column, 7 - row), 1, 1, facecolor=color or "none", edgecolor=GRID, lw=0.5, alpha=0.6
                )
            )
        rng, falls = np.random.default_rng(0), 0
        for walk in range(WALKS):
            state, _ = env.reset(seed=walk)
            places, over = [state], False
            while not over and len(places) < STEPS:
                state, _, over, _, _ = env.step(int(rng.integers(4)))
                places.append(state)
            falls += lake.unwrapped.desc[divmod(state, 8)] == b"H"
            rows, columns = np.divmod(places, 8)
            nudge = 0.5 + rng.uniform(-0.2, 0.2, 2)
            ax.plot(columns + nudge[0], 8 - rows - nudge[1], color=ON if shielded else OFF, lw=1.0, alpha=0.8)
        ax.set(title=f"{'shielded' if shielded else 'unshielded'}: {falls} of {WALKS} fall", xlim=(0, 8))
        ax.set_ylim(0, 8)
        bare(ax)
    return figure
