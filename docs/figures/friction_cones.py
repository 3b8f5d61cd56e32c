"""What an Ant's torques ask of its feet, and what pyramids give away of what the ground can give."""

import math
from dataclasses import replace

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import safe_wrappers as sw
from _style import FORBIDDEN, INK, OFF, ON, OTHER, SAFE, panels
from safe_wrappers.control.contact.friction_cone import normal_and_tangential
from safe_wrappers.control.legged.whole_body import (
    attainable_contact_acceleration,
    rigid_forces,
    solve_cone,
    solve_pyramid,
)
from safe_wrappers.control.legged.whole_body_problem import WholeBodyProblem
from safe_wrappers.plants.queries.floating_base import equations_of_motion

SHARE, EDGES, REACH = 0.7, (4, 6, 8, 12, 16, 24, 32), 1.6
TORQUE = 0.02
"""Of the full one: a standing Ant's feet slide from about there on."""


def problems(count: int) -> list[WholeBodyProblem]:
    """Of an Ant that stands while its motors twitch."""
    env = gym.make("Ant-v5")
    plant = sw.MujocoPlant()
    plant.bind(env)
    env.reset(seed=0)
    rng, found = np.random.default_rng(0), []
    for step in range(40 + count):
        action = TORQUE * rng.uniform(-1.0, 1.0, 8)
        env.step(action.astype(np.float32))
        if step < 40:
            continue
        plant.observe()
        terms = equations_of_motion(plant.model, plant.forward(), plant.actuators)
        c = terms.contacts
        problem = WholeBodyProblem(
            terms.inertia,
            terms.bias,
            terms.actuation,
            c.jacobians,
            c.drift,
            c.normals,
            SHARE * c.friction,
            plant.lower,
            plant.upper,
            TORQUE * rng.uniform(-1.0, 1.0, 8),
            first_tangents=np.tile([1.0, 0.0, 0.0], (len(c.points), 1)),
        )
        wanted = attainable_contact_acceleration(problem)
        found.append(replace(problem, contact_acceleration=wanted))
    return found


def sideways(forces: NDArray[np.float64], normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Tangential over normal force, of the contacts that press."""
    along, rest = normal_and_tangential(forces, normals)
    presses = along > 0.02
    return np.asarray(rest[presses, :2] / along[presses, None])


def draw() -> Figure:
    """Left: the cone from above. Right: the price of pyramids."""
    figure, (left, right) = panels(2, height=3.4)
    recorded = problems(40)
    exact = [solve_cone(p) for p in recorded]
    asked = [sideways(rigid_forces(p, p.nominal)[0], p.normals) for p in recorded]
    given = [sideways(a.forces, p.normals) for p, a in zip(recorded, exact, strict=True)]
    for points, color, label in ((asked, OFF, "asked by the policy"), (given, ON, "after the program")):
        x, y = np.concatenate(points).T
        left.plot(x, y, ".", color=color, ms=3.5, label=label)
    angle = np.linspace(0.0, math.tau, 200)
    left.plot(SHARE * np.cos(angle), SHARE * np.sin(angle), color=FORBIDDEN, lw=1.3)
    for edges, color in ((4, OTHER), (8, SAFE)):
        corner = math.tau / edges * np.arange(edges + 1)
        left.plot(SHARE * np.cos(corner), SHARE * np.sin(corner), color=color, lw=1.1)
    left.set(xlim=(-REACH, REACH), ylim=(-REACH, REACH), aspect="equal")
    left.set(xlabel="sideways over normal force, x", ylabel="the same, y")
    left.legend(loc="upper left", handletextpad=0.2)

    changed = [i for i, a in enumerate(exact) if a.status == "solved"]
    right.plot(EDGES, [100.0 * (1.0 - math.cos(math.pi / m)) for m in EDGES], color=INK, lw=1.0, ls="--")
    right.text(10.5, 5.5, "friction given away\nbetween two edges", color=INK)
    extra = []
    for edges in EDGES:
        answers = [solve_pyramid(recorded[i], edges) for i in changed]
        ways = [
            (
                np.linalg.norm(a.control - recorded[i].nominal),
                np.linalg.norm(exact[i].control - recorded[i].nominal),
            )
            for i, a in zip(changed, answers, strict=True)
        ]
        extra.append(100.0 * float(sum(w[0] - w[1] for w in ways) / sum(w[1] for w in ways)))
    right.plot(EDGES, extra, "o-", color=ON, ms=4)
    right.text(10.5, 0.8, "longer corrections", color=ON, ha="right")
    right.set_xscale("log", base=2)
    right.set_yscale("log")
    right.set_xticks([4, 8, 16, 32], ["4", "8", "16", "32"])
    right.set_yticks([1, 10, 30], ["1 %", "10 %", "30 %"])
    right.minorticks_off()
    right.set_xlabel("edges of the pyramid")
    return figure
