"""A mass at full throttle towards a springy wall: its speed on the way there, and the force that it arrives with."""

from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from matplotlib.figure import Figure

import safe_wrappers as sw
from _style import FORBIDDEN, OFF, ON, OTHER, panels
from safe_wrappers.errors import Array

LIMIT, STIFFNESS, MASS, PUSH = 140.0, 25e3, 6.0, 150.0
GAP, START, STEPS = 0.08, 0.3, 28
LATENCY = 0.03
"""Of the reactive brake, s."""


class Slide(gym.Env[Array, Array]):
    """A ball on a slide, pushed along x; its contact with the wall is a spring without damping."""

    frame_skip, dt = 10, 0.01

    def __init__(self) -> None:
        self.model = mujoco.MjModel.from_xml_string(
            f"""<mujoco><option timestep="0.001"/><worldbody>
            <geom name="wall" type="box" size=".05 .5 .5" pos="{GAP + 0.15} 0 0" condim="1" priority="1"/>
            <body name="cart"><joint name="x" axis="1 0 0" type="slide"/>
            <geom size=".1" mass="{MASS}" condim="1"/></body></worldbody>
            <actuator><motor joint="x" ctrlrange="-1 1" gear="{PUSH}"/></actuator></mujoco>"""
        )
        # With an impedance near 0 MuJoCo's contact is a spring of this stiffness.
        self.model.geom("wall").solref[:] = -STIFFNESS * self.model.body("cart").invweight0[0], 0.0
        self.model.geom("wall").solimp[:3] = 1e-3
        self.data = mujoco.MjData(self.model)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Array, dict[str, Any]]:
        """Before the wall, on its way."""
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qvel[0] = START
        self.fine: list[tuple[float, float, float]] = []
        return np.concatenate([self.data.qpos, self.data.qvel]), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Hold a force for a control step, and write down distance, speed and contact force of each substep."""
        self.data.ctrl[:] = action
        for _ in range(self.frame_skip):
            gap, speed = GAP - float(self.data.qpos[0]), float(self.data.qvel[0])
            mujoco.mj_step(self.model, self.data)
            self.fine.append((gap, speed, float(self.data.efc_force[: self.data.nefc].sum())))
        return np.concatenate([self.data.qpos, self.data.qvel]), 0.0, False, False, {}


def run(env: gym.Env[Any, Any], reacts: bool = False) -> Array:
    """Full throttle; or, reacting, full brake from the latency after the touch on. Shape (substeps, 3)."""
    env.reset()
    raw: Any = env.unwrapped
    touched = np.inf
    for k in range(STEPS):
        env.step(np.array([-1.0 if reacts and k * raw.dt >= touched + LATENCY else 1.0]))
        if raw.fine[-1][0] < 0.0:
            touched = min(touched, (k + 1) * raw.dt)
    return np.array(raw.fine)


def draw() -> Figure:
    """Left: speed against distance. Right: force in time."""
    figure, (way, force) = panels(2, height=3.0)
    limit = sw.constraints.ImpactSpeedLimit(
        ["cart"], ["wall"], force_limit=LIMIT, stiffness=STIFFNESS, margin=2.0, horizon=8
    )
    runs = {
        "unfiltered": (run(Slide()), OFF, "-"),
        f"brake {1e3 * LATENCY:g} ms after touch": (run(Slide(), reacts=True), OTHER, "--"),
        "filtered": (run(sw.CBFActionFilter(Slide(), [limit])), ON, "-"),
    }
    assert runs["filtered"][0][:, 2].max() <= LIMIT  # what the caption says
    for name, (fine, color, style) in runs.items():
        gap, speed, pressing = fine.T
        first = int(np.argmax(gap < 0.0)) + 1
        way.plot(1e3 * gap[:first], speed[:first], style, color=color, label=name)
        force.plot(1e-3 * np.arange(len(fine)), pressing, style, color=color, label=name)
    way.axhline(LIMIT / np.sqrt(STIFFNESS * MASS), color=FORBIDDEN, lw=1.2)
    way.invert_xaxis()
    way.set(xlabel="distance to the wall (mm)", ylabel="approach speed (m/s)")
    force.axhline(LIMIT, color=FORBIDDEN, lw=1.2)
    force.set(xlabel="time (s)", ylabel="contact force (N)")
    force.legend(loc="upper right")
    force.set_ylim(0.0, 1.5 * force.get_ylim()[1])
    return figure
