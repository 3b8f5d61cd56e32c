"""The README's moving picture: two agents on the same map, one trained without a filter, one through it.

    MUJOCO_GL=osmesa python -m benchmarks moving_picture

The policies are those of `configs/policies`, deterministic, each as it was trained. The film shows the first seconds
of the episodes with seeds 0, 1 and 2, each from the same reset on both sides. Whole episodes of the first hundred
seeds are counted beside it, for the README's caption. Colours, rings and trails are the renderer's alone; the
physics is the env's.
"""

import io
import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import matplotlib as mpl
import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from benchmarks.tables import RESULTS, options
from safe_wrappers.envs.patrolled_maze import MarkingRenderer
from safe_wrappers.train.policies import load_policy
from safe_wrappers.train.run.policy import TrainedPolicy
from safe_wrappers.train.run.stack import make_stack

ROOT = Path(__file__).parents[1]
FILM, COUNTS = ROOT / "docs" / "static" / "filter.webp", RESULTS / "moving_picture.json"
POLICIES = ROOT / "configs" / "policies"
SEEDS, SECONDS, SPEED, STRIDE = (0, 1, 2), 8.0, 2.0, 6
"""What is filmed: the first seconds of each seed's episode, times real time, a frame every so many steps."""
COUNTED = range(100)
"""Seeds of the whole episodes that are counted."""

PANEL, GAP, HEAD, FOOT, STRIP = 400, 12, 30, 54, 10
"""Pixels: a side's picture, what is between the two, the lines above and below it, the strip of time."""
CAMERA = {"distance": 4.3, "elevation": -72.0, "azimuth": 90.0, "lookat": np.array([0.0, -0.08, 0.0])}
INK, PAPER, BARE = (29, 35, 43), (255, 255, 255), (205, 210, 216)
CHANGED, CHANGED_TEXT, VIOLATED = (240, 165, 0), (184, 116, 0), (208, 32, 48)
SIDES = {
    "unfiltered": ("trained without a filter", (217, 114, 46)),
    "filtered": ("trained through the filter", (47, 134, 201)),
}
"""By the name of the policy: the words above it, and its colour."""
QUALITY = 62


@dataclass
class Count:
    """What happened on one side."""

    steps: int = 0
    violations: int = 0
    changed: int = 0
    goals: int = 0
    reward: float = 0.0

    def add(self, reward: Any, info: dict[str, Any]) -> None:
        """Count a step."""
        self.steps += 1
        self.violations += info["cost_substep"] > 0
        self.changed += bool(info.get("cbf/intervened", False))
        self.goals += bool(info.get("goal_met", False))
        self.reward += float(reward)


def make(trained: TrainedPolicy, **kwargs: Any) -> gym.Env[Any, Any]:
    """The env that a policy was trained in, with its filter, if it had one."""
    task = replace(trained.arm.env, kwargs={**trained.arm.env.kwargs, **kwargs})
    return make_stack(task, trained.arm.filter)


class Side:
    """One side of the film: a policy, its env, its counts, and what is drawn of it.

    Args:
        name: A key of `SIDES`.
    """

    def __init__(self, name: str) -> None:
        self.policy = load_policy(POLICIES / name, other_filter=True)
        self.title, self.colour = SIDES[name]
        self.filtered, self.count = self.policy.arm.filter.kind != "none", Count()
        shown = {"render_mode": "rgb_array", "width": PANEL, "height": PANEL}
        self.env = make(self.policy, **shown, default_camera_config=CAMERA)
        self.task: Any = self.env.unwrapped
        self.task.mujoco_renderer = MarkingRenderer(self.task.mujoco_renderer, self._markers)
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
        self.trail = [self.task.agent_position]
        self.mark: tuple[int, int, int] | None = None

    def step(self) -> tuple[bool, bool]:
        """One control step; whether it was changed, and whether it violated."""
        self.observation, reward, _, _, info = self.env.step(self.policy(self.observation))
        self.count.add(reward, info)
        self.trail.append(self.task.agent_position)
        flags = bool(info.get("cbf/intervened", False)), info["cost_substep"] > 0
        self.mark = VIOLATED if flags[1] else CHANGED if flags[0] else None
        return flags

    def frame(self) -> Image.Image:
        """The picture of now."""
        return Image.fromarray(np.asarray(self.env.render(), dtype=np.uint8))

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
    flags: list[list[tuple[bool, bool]]] = [[], []]
    shots = []
    for seed in SEEDS:
        for side in sides:
            side.reset(seed)
        for step in range(round(SECONDS / sides[0].task.dt)):
            for side, seen in zip(sides, flags, strict=True):
                seen.append(side.step())
            if step % STRIDE == 0:
                at = len(flags[0]) - 1
                shots.append((seed, at, [(side.frame(), replace(side.count)) for side in sides]))
    frames = []
    for seed, at, pair in shots:
        whole = Image.new("RGB", (2 * PANEL + GAP, HEAD + PANEL + FOOT + STRIP), PAPER)
        for k, (picture, count) in enumerate(pair):
            left = k * (PANEL + GAP)
            whole.paste(picture, (left, HEAD))
            _write(whole, left, sides[k], count, seed)
            whole.paste(strip(flags[k], at), (left, HEAD + PANEL + FOOT))
        frames.append(whole)
    return frames


def _write(whole: Image.Image, left: int, side: Side, count: Count, seed: int) -> None:
    draw = ImageDraw.Draw(whole)
    draw.text((left + 4, 5), side.title, side.colour, font(17, bold=True))
    draw.text((left + PANEL - 4, 8), f"seed {seed}", INK, font(14), anchor="ra")
    top = HEAD + PANEL + 6
    hurt = VIOLATED if count.violations else INK
    draw.text((left + 4, top), f"{count.violations} steps in a hazard", hurt, font(17, bold=True))
    draw.text((left + PANEL - 4, top + 1), f"goals: {count.goals}", INK, font(15), anchor="ra")
    if side.filtered:
        changed = f"the filter changed {count.changed / count.steps:.0%} of the actions"
        draw.text((left + 4, top + 24), changed, CHANGED_TEXT, font(15))


def font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """Matplotlib's own, the same everywhere."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(Path(mpl.get_data_path()) / "fonts" / "ttf" / name, size)


def strip(flags: list[tuple[bool, bool]], at: int) -> Image.Image:
    """What happened at every step of the film, up to now."""
    row = np.tile(np.array(BARE, np.uint8), (PANEL, 1))
    for k, (changed, violated) in enumerate(flags[: at + 1]):
        first, last = k * PANEL // len(flags), (k + 1) * PANEL // len(flags)
        if changed or violated:
            row[first : max(last, first + 2)] = VIOLATED if violated else CHANGED
    now = at * PANEL // len(flags)
    row[max(0, now - 1) : now + 2] = INK
    return Image.fromarray(np.tile(row[None], (STRIP, 1, 1)))


def encode(frames: list[Image.Image], frame_ms: float, quality: int = QUALITY) -> bytes:
    """An endless animated WebP."""
    data = io.BytesIO()
    frames[0].save(
        data,
        "WEBP",
        save_all=True,
        append_images=frames[1:],
        duration=round(frame_ms),
        loop=0,
        quality=quality,
        method=6,
    )
    return data.getvalue()


def whole_episodes() -> dict[str, Any]:
    """Whole episodes on both sides."""
    found = {}
    for name in SIDES:
        trained = load_policy(POLICIES / name, other_filter=True)
        env, total = make(trained), Count()
        for seed in COUNTED:
            observation, _ = env.reset(seed=seed)
            trained.reset()
            truncated = False
            while not truncated:
                observation, reward, _, truncated, info = env.step(trained(observation))
                total.add(reward, info)
        steps = trained.arm.total_steps * trained.arm.action_repeat
        about = {"algorithm": trained.arm.algorithm, "trained_for": steps, "episodes": len(COUNTED)}
        found[name] = about | asdict(total)
    return found


def main() -> None:
    """Film, count."""
    options(__doc__)
    frames = film()
    FILM.write_bytes(encode(frames, 1000 * STRIDE * 0.02 / SPEED))
    counts = whole_episodes()
    COUNTS.write_text(json.dumps(counts, indent=1) + "\n")
    print(f"{FILM}: {len(frames)} frames, {FILM.stat().st_size / 1e6:.2f} MB")
    print(json.dumps(counts, indent=1))
