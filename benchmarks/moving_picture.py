"""The README's moving picture: two agents on the same map, one trained without a filter, one through it.

    MUJOCO_GL=osmesa python -m benchmarks moving_picture

The policies are those of `configs/policies`, deterministic, each as it was trained. The film shows the first seconds
of the episodes with seeds 0, 1 and 2, each from the same reset on both sides. Colours, rings and trails are the
renderer's alone; the physics is the env's.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from benchmarks.tables import options
from safe_wrappers.train.policies import load_policy
from safe_wrappers.train.videos import encode, with_strip
from safe_wrappers.wrappers.safety_overlay import set_size

ROOT = Path(__file__).parents[1]
FILM = ROOT / "docs" / "static" / "filter.webp"
POLICIES = ROOT / "configs" / "policies"
SEEDS, STEPS, SPEED, STRIDE = (0, 1, 2), 400, 2.0, 6
"""What is filmed: the first steps of each seed's episode, times real time, a frame every so many steps."""

PANEL, GAP, HEAD, FOOT = 400, 12, 30, 54
"""Pixels: a side's picture, what is between the two, the lines above and below it."""
CAMERA = {"distance": 4.3, "elevation": -72.0, "azimuth": 90.0, "lookat": np.array([0.0, -0.08, 0.0])}
INK, PAPER = (29, 35, 43), (255, 255, 255)
CHANGED, CHANGED_TEXT, VIOLATED = (240, 165, 0), (184, 116, 0), (208, 32, 48)
SIDES = {
    "unfiltered": ("trained without a filter", (217, 114, 46)),
    "filtered": ("trained through the filter", (47, 134, 201)),
}
"""By the name of the policy: the words above it, and its colour."""


@dataclass
class Count:
    """What happened on one side."""

    steps: int = 0
    violations: int = 0
    changed: int = 0
    goals: int = 0

    def add(self, info: dict[str, Any]) -> None:
        """Count a step."""
        self.steps += 1
        self.violations += info["cost_substep"] > 0
        self.changed += bool(info.get("cbf/intervened", False))
        self.goals += bool(info.get("goal_met", False))


class Side:
    """One side of the film: a policy, its env, its counts, and what is drawn of it.

    Args:
        name: A key of `SIDES`.
    """

    def __init__(self, name: str) -> None:
        self.policy = load_policy(POLICIES / name, other_filter=True)
        self.title, self.colour = SIDES[name]
        self.filtered, self.count = self.policy.arm.filter.kind != "none", Count()
        self.flags = np.zeros((2, len(SEEDS) * STEPS), bool)  # changed, in violation
        self.env = self.policy.make_env("trained", "rgb_array")
        set_size(self.env, PANEL, PANEL)
        self.task: Any = self.env.unwrapped
        self.task.mujoco_renderer.default_cam_config = CAMERA
        model = self.task.model
        for geom in range(model.ngeom):
            if model.geom(geom).name in ("agent", "pointarrow"):
                model.geom_rgba[geom] = 0.16, 0.19, 0.23, 1.0
            elif model.geom_bodyid[geom] and model.geom_size[geom, 0] == self.task.hazard_radius:
                model.geom_rgba[geom] = 0.93, 0.5, 0.52, 0.8

    def reset(self, seed: int) -> None:
        """Begin an episode."""
        self.observation, _ = self.env.reset(seed=seed)
        self.policy.reset()
        self.seed, self.trail = seed, [self.task.agent_position]
        self.mark: tuple[int, int, int] | None = None

    def step(self) -> None:
        """One control step."""
        self.observation, _, _, _, info = self.env.step(self.policy(self.observation))
        self.count.add(info)
        self.trail.append(self.task.agent_position)
        changed, violated = bool(info.get("cbf/intervened", False)), info["cost_substep"] > 0
        self.flags[:, self.count.steps - 1] = changed, violated
        self.mark = VIOLATED if violated else CHANGED if changed else None

    def frame(self) -> Image.Image:
        """The picture of now, between words, and the strip of time."""
        for marker in self._markers():
            self.task.mujoco_renderer._get_viewer("rgb_array").add_marker(**marker)
        whole = Image.new("RGB", (PANEL, HEAD + PANEL + FOOT), PAPER)
        whole.paste(Image.fromarray(np.asarray(self.env.render(), dtype=np.uint8)), (0, HEAD))
        draw, count, top = ImageDraw.Draw(whole), self.count, HEAD + PANEL + 6
        draw.text((4, 5), self.title, self.colour, font(17, bold=True))
        draw.text((PANEL - 4, 8), f"seed {self.seed}", INK, font(14), anchor="ra")
        hurt = VIOLATED if count.violations else INK
        draw.text((4, top), f"{count.violations} steps in a hazard", hurt, font(17, bold=True))
        draw.text((PANEL - 4, top + 1), f"goals: {count.goals}", INK, font(15), anchor="ra")
        if self.filtered:
            changed = f"the filter changed {count.changed / count.steps:.0%} of the actions"
            draw.text((4, top + 24), changed, CHANGED_TEXT, font(15))
        return with_strip(whole, self.count.steps - 1, *self.flags)

    def _markers(self) -> list[dict[str, Any]]:
        """Where it came from in the last two seconds, and a ring while the filter acts or a hazard is entered."""
        recent = self.trail[-100:]
        drawn = [
            _marker(mujoco.mjtGeom.mjGEOM_SPHERE, 0.022, place, 0.012, self.colour, 0.25 + 0.6 * k / 100)
            for k, place in enumerate(recent)
            if k % 3 == 0
        ]
        if self.mark is not None:
            drawn.append(_marker(mujoco.mjtGeom.mjGEOM_CYLINDER, 0.155, self.trail[-1], 0.03, self.mark, 0.9))
        return drawn


def _marker(
    kind: Any, size: float, place: NDArray[np.float64], z: float, colour: tuple[int, int, int], alpha: float
) -> dict[str, Any]:
    return {
        "type": kind,
        "size": np.array([size, 0.004, 0.0]),  # a sphere has no second number
        "pos": np.array([*place, z]),
        "rgba": np.array([*(c / 255 for c in colour), alpha]),
    }


def film() -> list[Image.Image]:
    """The frames, both sides of each."""
    sides = [Side(name) for name in SIDES]
    frames = []
    for seed in SEEDS:
        for side in sides:
            side.reset(seed)
        for step in range(STEPS):
            for side in sides:
                side.step()
            if step % STRIDE == 0:
                frames.append(beside(*(side.frame() for side in sides)))
    return frames


def beside(left: Image.Image, right: Image.Image) -> Image.Image:
    """Two pictures of the same height as one."""
    gap = np.full((left.height, GAP, 3), PAPER, np.uint8)
    return Image.fromarray(np.hstack([np.asarray(left), gap, np.asarray(right)]))


def font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """Matplotlib's own, the same everywhere."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(Path(mpl.get_data_path()) / "fonts" / "ttf" / name, size)


def main() -> None:
    """Film."""
    options(__doc__)
    frames = film()
    FILM.write_bytes(encode(frames, 1000 * STRIDE * 0.02 / SPEED, quality=62, method=6))
    print(f"{FILM}: {len(frames)} frames, {FILM.stat().st_size / 1e6:.2f} MB")
