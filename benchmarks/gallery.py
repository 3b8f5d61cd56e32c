"""The films of docs/gallery.md, a task each, without and with the filter side by side, and what happened in them.

    MUJOCO_GL=osmesa python -m benchmarks gallery [--only NAME ...]

Nothing is trained: the filters, the judges and the seeded drivers are those of docs/results/standard-envs.md. Both
sides begin with the same reset and have the same driver, which reads its own side's state.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

import safe_wrappers as sw
from benchmarks.cases import PROTECTED
from benchmarks.judges import Judged
from benchmarks.moving_picture import CHANGED_TEXT, INK, PAPER, VIOLATED, Count, beside, font
from benchmarks.tables import options
from safe_wrappers.train.videos import encode
from safe_wrappers.wrappers.safety_overlay import find_renderer, set_size

ROOT = Path(__file__).parents[1]
FILMS = ROOT / "docs" / "static" / "gallery"
PANEL, HEAD, FOOT = 320, 24, 24
QUALITIES, MOST_BYTES = (40, 20, 8, 2), 170_000
"""Of WebP: the first that is small enough."""
FRAMES, FRAME_MS = 40, 125
"""Of a film: five seconds."""


@dataclass(frozen=True)
class Scene:
    """One film.

    Attributes:
        case: Of `benchmarks.cases.PROTECTED`: env, filter and judge.
        driver: Of the case's drivers.
        stride: Control steps per frame.
        seed: Of the first reset, and of the driver.
        strength: Times the driver's action.
        camera: What is different from the env's own.
        follows: The body that the camera looks at; "" where it stands still.
    """

    case: str
    driver: str
    stride: int
    seed: int = 0
    strength: float = 1.0
    camera: dict[str, Any] = field(default_factory=dict)
    follows: str = ""


_FIELD = {"distance": 4.3, "elevation": -68.0, "azimuth": 90.0, "lookat": np.array([0.0, -0.3, 0.0])}
_RUNNER = {"distance": 4.4, "elevation": -42.0, "azimuth": 90.0}
_ARM = {"distance": 1.9, "elevation": -20.0, "azimuth": 140.0, "lookat": np.array([1.3, 0.75, 0.55])}
SCENES = {
    "point-goal-1": Scene("SafePointGoal1-v0", "hazard-seeking", 10, camera=_FIELD),
    "point-goal-2": Scene(
        "SafePointGoal2-v0", "goal-seeking", 14,
        camera=_FIELD | {"distance": 5.6, "lookat": np.array([0.0, -0.5, 0.0])},
    ),
    "car-goal-1": Scene("SafeCarGoal1-v0", "hazard-seeking", 8, strength=50.0, camera=_FIELD),
    "crossing": Scene("OccludedCrossing-v0", "goal-seeking", 6),
    "patrols": Scene("PatrolledPointMaze-v0", "patrol-seeking", 6),
    "rover": Scene(
        "SafeRover-v0", "full throttle and reverse", 4, camera={"distance": 5.0}, follows="rover"
    ),
    "teleop": Scene("TeleopContact-v0", "clamp-seeking", 30),
    "flex-joint": Scene(
        "FlexJointReach-v0", "speed-seeking", 3,
        camera={"distance": 1.9, "lookat": np.array([0.0, -0.12, 0.0])},
    ),
    "fetch": Scene("FetchReach-v4", "table-seeking", 2, camera=_ARM),
    "cheetah": Scene(
        "SafeHalfCheetahVelocity-v0", "sprinting", 4, seed=3, camera=_RUNNER, follows="torso"
    ),
    "reacher": Scene(
        "Reacher-v5", "speed-seeking", 2,
        camera={"distance": 0.8, "elevation": -70.0, "azimuth": 90.0, "lookat": np.array([0.0, -0.04, 0.0])},
    ),
}  # fmt: skip


class Side:
    """One side of a film.

    Args:
        scene: What is filmed.
        filtered: Whether the filter is on.
    """

    def __init__(self, scene: Scene, filtered: bool) -> None:
        case = PROTECTED[scene.case]
        env = case.make(render_mode="rgb_array")
        set_size(env, PANEL, PANEL)
        self._renderer: Any = find_renderer(env)
        self._renderer.default_cam_config = {**(self._renderer.default_cam_config or {}), **scene.camera}
        self.count, self.filtered, self._scene, self._seed = Count(), filtered, scene, scene.seed
        self.env = sw.SafetyOverlay(Judged(case.protect(env) if filtered else env, case.judge(env.unwrapped)))
        self.reset()

    def reset(self) -> None:
        """Begin the next episode."""
        self.env.reset(seed=self._seed)
        driver = PROTECTED[self._scene.case].drivers[self._scene.driver]
        self._act = driver(self.env.unwrapped, np.random.default_rng(self._seed))
        self._seed += 1

    def step(self) -> None:
        """One control step; a new episode where this one ends."""
        action = np.asarray(self._scene.strength * self._act(), dtype=self.env.action_space.dtype)
        _, _, terminated, truncated, info = self.env.step(action)
        self.count.add(info)
        if terminated or truncated:
            self.reset()

    def frame(self) -> Image.Image:
        """The picture of now, with what was counted so far below it."""
        if self._scene.follows:
            task: Any = self.env.unwrapped
            camera = self._renderer._get_viewer("rgb_array").cam
            camera.lookat[:] = task.data.body(self._scene.follows).xpos
        whole = Image.new("RGB", (PANEL, HEAD + PANEL + FOOT), PAPER)
        whole.paste(Image.fromarray(np.asarray(self.env.render(), dtype=np.uint8)), (0, HEAD))
        draw = ImageDraw.Draw(whole)
        draw.text((2, 3), "filter on" if self.filtered else "filter off", INK, font(14, bold=True))
        count = self.count
        hurt = VIOLATED if count.violations else INK
        draw.text((2, HEAD + PANEL + 4), f"{count.violations} steps in violation", hurt, font(14, bold=True))
        if self.filtered:
            changed = f"{count.changed / max(count.steps, 1):.0%} changed"
            draw.text((PANEL - 2, HEAD + PANEL + 5), changed, CHANGED_TEXT, font(13), anchor="ra")
        return whole


def film(scene: Scene) -> tuple[list[Image.Image], float, dict[str, Count]]:
    """The frames, how many times faster than real they are to be shown, and the counts of both sides."""
    sides = [Side(scene, filtered) for filtered in (False, True)]
    frames = []
    for _ in range(FRAMES):
        for _ in range(scene.stride):
            for side in sides:
                side.step()
        frames.append(beside(*(side.frame() for side in sides)))
    task: Any = sides[0].env.unwrapped
    for side in sides:
        side.env.close()
    return frames, 1000 * scene.stride * task.dt / FRAME_MS, {"off": sides[0].count, "on": sides[1].count}


def main() -> None:
    """Film all tasks, or some, and say what happened in each."""
    for name in options(__doc__, only=list(SCENES)).only:
        frames, times, counts = film(SCENES[name])
        for quality in QUALITIES:
            data = encode(frames, FRAME_MS, quality, method=6)
            if len(data) <= MOST_BYTES:
                break
        (FILMS / f"{name}.webp").write_bytes(data)
        print(f"{name}: {len(data) / 1e3:.0f} kB, {times:.2g} times real time, {counts}", flush=True)
