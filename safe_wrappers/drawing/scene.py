"""Marks in MuJoCo's own scene, actions as arrows where they push, and a strip on the frame."""

import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers import info as keys
from safe_wrappers.checks import Array
from safe_wrappers.drawing.marks import COLOURS, Mark, Role, arrow
from safe_wrappers.plants.displacement import DisplacementPlant
from safe_wrappers.plants.mujoco.plant import MujocoPlant
from safe_wrappers.plants.plant import Plant

if TYPE_CHECKING:
    from PIL import ImageDraw

MOST_MARKS: Final = 500
"""Of one frame. Gymnasium's scene has room for 1000 shapes, the model's own among them."""

_MOST_ACTUATORS: Final = 2
"""An arrow shows two numbers: machines with more actuators have bars alone."""
_LENGTH, _THICKNESS = 4.0, 0.3
"""Of the longest arrow, in sizes of the body."""
_SIZES: Final = {"arrow": np.array([1.0, 1.0, 2.0])}
"""MuJoCo draws an arrow half as long as its size says."""


def find_renderer(env: gym.Env[Any, Any]) -> Any | None:
    """The `MujocoRenderer` of an env, or of the robot's env that it holds, as a maze does; None: it has none."""
    raw: Any = env.unwrapped
    held = [raw, *(inner for inner in vars(raw).values() if isinstance(inner, gym.Env))]
    found = (getattr(one, "mujoco_renderer", None) for one in held)
    return next((renderer for renderer in found if renderer is not None), None)


def set_size(env: gym.Env[Any, Any], width: int, height: int) -> None:
    """Have an env of which no frame has been asked yet draw frames of this size, px; others stay as they are."""
    renderer = find_renderer(env)
    if renderer is not None:
        renderer.width, renderer.height = width, height
        drawn = renderer.model.vis.global_
        drawn.offwidth, drawn.offheight = width, height


def put(marks: Sequence[Mark], renderer: Any, render_mode: str) -> None:
    """Have the next frame show marks; model and data stay bit for bit as they are.

    Args:
        marks: The first `MOST_MARKS` of them are drawn.
        renderer: Found by `find_renderer`.
        render_mode: "rgb_array" or "human".
    """
    viewer = renderer._get_viewer(render_mode)
    for mark in marks[:MOST_MARKS]:
        viewer.add_marker(
            type=getattr(mujoco.mjtGeom, f"mjGEOM_{mark.shape.upper()}"),
            pos=mark.position,
            size=mark.size * _SIZES.get(mark.shape, 1.0),
            mat=mark.axes.ravel(),
            rgba=COLOURS[mark.role],
        )


def arrows(plant: Plant, specs: Iterable[Any], proposed: Array, executed: Array) -> list[Mark]:
    """Two arrows at a machine, the executed one above; none where it is not known which way an action goes.

    Args:
        plant: After it has observed.
        specs: Constraints; the first body that one of them names is pushed.
        proposed: Action, shape (m,).
        executed: Likewise.
    """
    body: str | None
    if isinstance(plant, DisplacementPlant):
        body, ways = plant.gripper, np.eye(3, plant.lower.size)
        at, _ = plant.motion("body", body)
    elif isinstance(plant, MujocoPlant) and plant.has_acceleration and plant.lower.size <= _MOST_ACTUATORS:
        named = (
            getattr(spec, "body", None) or next(iter(getattr(spec, "bodies", ())), None) for spec in specs
        )
        body = next((name for name in named if name), _only_body(plant))
        if body is None:
            return []
        at, ways = _pushes(plant, plant.named("body", body))
    else:
        return []
    # The longest push of a corner of the box has the full length; beyond `acting_range` nothing pushes harder.
    low, high = plant.acting_range if plant.has_acceleration else (plant.lower, plant.upper)
    reach = float(np.linalg.norm(np.abs(ways) @ np.maximum(np.abs(low), np.abs(high))))
    size = float(
        plant.model.geom_rbound[plant.model.geom_bodyid == plant.named("body", body)].max(initial=0.0)
    )
    if not (0.0 < reach < np.inf and size > 0.0):
        return []
    found = []
    roles: tuple[tuple[Role, Array], ...] = ("proposed", proposed), ("executed", executed)
    for i, (role, action) in enumerate(roles):
        vector = ways @ np.clip(action, low, high) * (_LENGTH * size / reach)
        if float(np.linalg.norm(vector)) > _THICKNESS * size:  # a shorter one is all head
            over = at + np.array([0.0, 0.0, (1.0 + 0.7 * i) * size])
            found.append(arrow(role, over, vector, _THICKNESS * size))
    return found


def _pushes(plant: MujocoPlant, body: int) -> tuple[Array, Array]:
    """A body's centre of mass, m, and what each action does to its acceleration: a turn alone does not push it."""
    data, jacobian = plant.forward(), np.zeros((3, plant.model.nv))
    mujoco.mj_jacBodyCom(plant.model, data, jacobian, None, body)
    return data.xipos[body].copy(), jacobian @ plant.acceleration[1]


def _only_body(plant: MujocoPlant) -> str | None:
    """The body that moves, if there is one alone."""
    moving = sorted({int(plant.model.jnt_bodyid[j]) for j in range(plant.model.njnt)})
    return plant.model.body(moving[0]).name or None if len(moving) == 1 else None


Pixels = NDArray[np.uint8]
Colour = tuple[int, int, int]

STEPS: Final = 150
"""How many of the last steps the strip shows."""
MOST_BARS: Final = 12
"""Of more actions only the first are shown."""
_SHARE: Final = 0.14  # of the frame's height
_LEAST_WIDTH: Final = 240  # px; a narrower frame has no room for words
_LEAST: Final = 60  # px; a smaller frame stays as it is
_DARKNESS: Final = 0.25  # share of the frame's light that is left under the strip
_GREY: Final[Colour] = (150, 158, 168)
_WHITE: Final[Colour] = (240, 242, 245)
STATES: Final[dict[str, Colour]] = {
    "as proposed": _GREY,
    "changed": (250, 180, 20),
    "braked": (80, 160, 250),
    "fallback": (250, 110, 30),
    "violation": (230, 45, 60),
}
"""What is said of a step, the worst last, and its colour."""


def state_of(info: dict[str, Any]) -> str:
    """Which of `STATES` a step was in."""
    found = "as proposed"
    if info.get(keys.CBF_INTERVENED, False):
        found = "changed"
    if info.get(keys.LEASE_BRAKING, False) or info.get(keys.TELEOP_REVOKED, False):
        found = "braked"
    if info.get(keys.CBF_FALLBACK, False):
        found = "fallback"
    if info.get(keys.COST_SUBSTEP, 0.0) > 0.0 or info.get(keys.COST, 0.0) > 0.0:
        found = "violation"
    return found


def words_of(info: dict[str, Any]) -> list[str]:
    """What is said beside the state: the numbers that info has."""
    found = []
    if info.get(keys.CBF_MARGIN, 0.0) != 0.0:  # 0 is written where there is no h at all
        found.append(f"margin {info[keys.CBF_MARGIN]:.3g}")
    if keys.LEASE_REMAINING_S in info:
        found.append(f"lease {info[keys.LEASE_REMAINING_S]:.2f} s")
    if keys.TELEOP_ROUND_TRIP_S in info:
        found.append(f"round trip {info[keys.TELEOP_ROUND_TRIP_S]:.2f} s")
    if keys.SLIP_RATIO in info:
        found.append(f"slip {np.abs(info[keys.SLIP_RATIO]).max():.2f}")
    return found


@dataclass
class Strip:
    """The last steps of an episode, and how they are drawn.

    Attributes:
        low: The smallest actions, shape (m,), or None: no bars.
        high: The largest.
    """

    low: Array | None = None
    high: Array | None = None
    _steps: deque[tuple[float, str]] = field(default_factory=lambda: deque(maxlen=STEPS))
    _info: dict[str, Any] = field(default_factory=dict)

    def begin(self, info: dict[str, Any]) -> None:
        """Forget the last episode; `info` is the reset's."""
        self._steps.clear()
        self._info = dict(info)

    def add(self, info: dict[str, Any]) -> None:
        """Take a step's info."""
        self._info = dict(info)
        self._steps.append((float(info.get(keys.CBF_MARGIN, math.nan)), state_of(info)))

    @property
    def words(self) -> list[str]:
        """The state of the last step, then the numbers."""
        return [state_of(self._info), *words_of(self._info)]

    def on(self, frame: Pixels) -> Pixels:
        """A copy of a frame, shape (height, width, 3), with the strip over its lower edge; a small one as it is."""
        from PIL import Image, ImageDraw  # here: who imports the library need not draw

        height, width = frame.shape[:2]
        if min(height, width) < _LEAST:
            return frame
        tall = max(12, round(_SHARE * height))
        whole = np.array(frame[..., :3], dtype=np.uint8)
        whole[height - tall :] = (_DARKNESS * whole[height - tall :]).astype(np.uint8)
        picture = Image.fromarray(whole)
        draw = ImageDraw.Draw(picture)
        edge = max(2, tall // 12)
        low, high = self._actions()
        bars = min(width // 4, 2 * tall) if low is not None else 0
        words = tall // 2 if width >= _LEAST_WIDTH else 0
        if words:
            self._write(draw, edge, height - tall + edge, words - edge, width - bars - 2 * edge)
        self._chart(draw, (edge, height - tall + words + edge, width - bars - 2 * edge, height - edge))
        if low is not None and high is not None:
            self._bars(draw, (width - bars, height - tall + edge, width - edge, height - edge), low, high)
        return np.asarray(picture)

    def _actions(self) -> tuple[Array | None, Array | None]:
        """The bounds, where there are actions to show between them."""
        there = self.low is not None and keys.EXECUTED_ACTION in self._info
        return (self.low, self.high) if there else (None, None)

    def _write(self, draw: "ImageDraw.ImageDraw", left: int, top: int, tall: int, right: int) -> None:
        """The state with its colour, then the numbers, as far as there is room."""
        from PIL import ImageFont

        font = ImageFont.load_default(size=max(9, round(0.6 * tall)))
        state, *rest = self.words
        middle, x = top + tall / 2, left + tall // 4
        draw.ellipse((x, middle - tall / 4, x + tall / 2, middle + tall / 4), fill=STATES[state])
        x += round(0.75 * tall)
        widest = max(draw.textlength(s, font) for s in STATES)
        for text, room in ((state, widest), *((word, draw.textlength(word, font)) for word in rest)):
            if x + room > right:
                break
            draw.text((x, middle), text, fill=_WHITE, font=font, anchor="lm")
            x += round(room + 0.6 * tall)

    def _chart(self, draw: "ImageDraw.ImageDraw", box: tuple[int, int, int, int]) -> None:
        """A column per step, the last one at the right: as high as the margin, in the colour of the state."""
        left, top, right, bottom = box
        draw.line((left, bottom, right, bottom), fill=_GREY)
        margins = [abs(margin) for margin, _ in self._steps if math.isfinite(margin)]
        tallest = max(margins, default=0.0)
        wide = (right - left) / STEPS
        for age, (margin, state) in enumerate(reversed(self._steps)):
            share = abs(margin) / tallest if tallest > 0.0 and math.isfinite(margin) else 0.0
            high = bottom - max(2.0, share * (bottom - top))
            x = right - (age + 1) * wide
            draw.rectangle((x, high, max(x, x + wide - 1.0), bottom), fill=STATES[state])

    def _bars(
        self, draw: "ImageDraw.ImageDraw", box: tuple[int, int, int, int], low: Array, high: Array
    ) -> None:
        """For every action a column from its smallest to its largest value: proposed and executed as two marks."""
        left, top, right, bottom = box
        span = np.where(high > low, high - low, 1.0)
        shown = min(len(low), MOST_BARS)
        wide = (right - left) / shown
        pairs: Sequence[tuple[str, float, float]] = (
            (keys.PROPOSED_ACTION, 0.08, 0.46),
            (keys.EXECUTED_ACTION, 0.54, 0.92),
        )
        for key, start, end in pairs:
            if key not in self._info:  # a lease without a filter tells what was executed alone
                continue
            colour = colour_of("proposed" if key == keys.PROPOSED_ACTION else "executed")
            shares = np.clip((np.ravel(self._info[key]) - low) / span, 0.0, 1.0)
            zero = np.clip(-low / span, 0.0, 1.0)
            for i in range(shown):
                x = left + i * wide
                ends = sorted(bottom - (bottom - top) * share for share in (shares[i], zero[i]))
                draw.rectangle((x + start * wide, ends[0] - 1, x + end * wide, ends[1] + 1), fill=colour)
        for i in range(shown):
            y = bottom - (bottom - top) * float(np.clip(-low[i] / span[i], 0.0, 1.0))
            draw.line((left + i * wide, y, left + (i + 1) * wide - 1, y), fill=_WHITE)


def colour_of(role: Any) -> Colour:
    """A mark's colour in whole numbers."""
    red, green, blue, _ = COLOURS[role]
    return round(255 * red), round(255 * green), round(255 * blue)
