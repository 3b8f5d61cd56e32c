"""An episode from above: where the robot went, where the filter acted, where it hurt."""

from __future__ import annotations

from collections.abc import Iterator

from matplotlib.axes import Axes
from matplotlib.patches import Circle, Rectangle

from ..evaluation.scene import Scene
from ..files import Row
from .canvas import BAD, GOAL, HAZARD, INK, MARK, VASE, arm_color, arm_key, draw
from .picture import Key, Picture, Plotted

Frame = tuple[float, float, float, float]
"""x from, x to, y from, y to, m."""


def scene_frame(*scenes: Scene) -> Frame:
    """A frame that holds all that the scenes hold."""
    xs: list[float] = []
    ys: list[float] = []
    for scene in scenes:
        for points, radius in (
            (scene.agent, 0.05),
            (scene.goals, scene.goal_radius),
            (scene.hazards, scene.hazard_radius),
            (scene.vases, 0.1),
        ):
            for x, y in points:
                xs += [x - radius, x + radius]
                ys += [y - radius, y + radius]
    return min(xs), max(xs), min(ys), max(ys)


def scene_picture(name: str, title: str, scene: Scene, color: int, frame: Frame) -> Picture:
    """The robot's path among hazards, goals and vases.

    Args:
        name: Unique on the page.
        title: Of the picture.
        scene: The episode.
        color: The arm's place among the arms.
        frame: From `scene_frame`.
    """
    violated, changed = int(scene.violated.sum()), int(scene.intervened.sum())
    steps = len(scene.violated)
    reading = f"{violated:,} of {steps:,} steps in violation, {changed:,} changed by the filter."

    def paint(axes: Axes) -> None:
        axes.set_aspect("equal")
        axes.set_xlim(*frame[:2])
        axes.set_ylim(*frame[2:])
        axes.set(xlabel="x in m", title="y in m")
        _paint(axes, scene, arm_color(color))

    keys: dict[str, Key] = {"path": (arm_key(color), "line")}
    if changed:
        keys["filter changed the action"] = ("mark", "fill")
    if violated:
        keys["violation"] = ("bad", "fill")
    keys |= {"hazard": ("hazard", "fill"), "goals, in order": ("goal", "ring")}
    if len(scene.vases):
        keys["vase"] = ("vase", "fill")
    keys["start"] = ("ink", "ring")
    data = Plotted(name, ("what", "x_m", "y_m", "radius_m", "changed", "violated"), list(_rows(scene)))
    return Picture(title, reading, draw(name, f"{title}. {reading}", paint, height=3.9), keys, data)


def _rows(scene: Scene) -> Iterator[Row]:
    """What stands there, and the path in the order of the steps; its last place has no step after it."""
    for what, places, radius in (
        ("hazard", scene.hazards, scene.hazard_radius),
        ("goal", scene.goals, scene.goal_radius),
    ):
        for x, y in places:
            yield {"what": what, "x_m": float(x), "y_m": float(y), "radius_m": float(radius)}
    for x, y in scene.vases:
        yield {"what": "vase", "x_m": float(x), "y_m": float(y)}
    for step, (x, y) in enumerate(scene.agent):
        place: Row = {"what": "path", "x_m": float(x), "y_m": float(y)}
        if step < len(scene.violated):
            flags = {"changed": bool(scene.intervened[step]), "violated": bool(scene.violated[step])}
            place = {**place, **flags}
        yield place


def _paint(axes: Axes, scene: Scene, color: str) -> None:
    for x, y in scene.hazards:
        axes.add_patch(Circle((x, y), scene.hazard_radius, facecolor=HAZARD, alpha=0.35, linewidth=0))
    for x, y in scene.vases:
        axes.add_patch(Rectangle((x - 0.08, y - 0.08), 0.16, 0.16, facecolor=VASE, alpha=0.5))
    for number, (x, y) in enumerate(scene.goals, start=1):
        axes.add_patch(Circle((x, y), scene.goal_radius, facecolor=GOAL, alpha=0.1, edgecolor=GOAL))
        axes.text(x, y, str(number), color=GOAL, ha="center", va="center", weight="bold")
    path = scene.agent
    axes.plot(path[:, 0], path[:, 1], color=color, linewidth=1.3, solid_joinstyle="round")
    for places, mark, size in ((scene.intervened, MARK, 8), (scene.violated, BAD, 14)):
        x, y = path[:-1][places].T
        axes.scatter(x, y, s=size, color=mark, zorder=3, linewidths=0)
    axes.plot(*path[0], marker="o", markersize=8, markerfacecolor="none", markeredgecolor=INK, zorder=4)
