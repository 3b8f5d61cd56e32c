"""The strip over a frame's lower edge: what was done to the last action, the last margins, and the actions."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from safe_wrappers import info as keys
from safe_wrappers.errors import Array

Pixels = NDArray[np.uint8]
Colour = tuple[int, int, int]

STEPS: Final = 150
"""How many of the last steps the strip shows."""
MOST_BARS: Final = 12
"""Of more actions only the first are shown."""
ACTIONS: Final = {keys.PROPOSED_ACTION: (242, 107, 26), keys.EXECUTED_ACTION: (26, 115, 230)}
"""Their colours."""
STATES: Final[dict[str, tuple[Colour, tuple[str, ...]]]] = {
    "violation": ((230, 45, 60), (keys.COST_SUBSTEP, keys.COST)),
    "fallback": ((250, 110, 30), (keys.CBF_FALLBACK,)),
    "braked": ((80, 160, 250), (keys.LEASE_BRAKING, keys.TELEOP_REVOKED)),
    "changed": ((250, 180, 20), (keys.CBF_INTERVENED,)),
    "as proposed": ((150, 158, 168), ()),
}
"""What is said of a step, the worst first: its colour, and the info keys of which one above 0 says so."""
WORDS: Final = {
    keys.CBF_MARGIN: "margin {:.3g}",
    keys.LEASE_REMAINING_S: "lease {:.2f} s",
    keys.TELEOP_ROUND_TRIP_S: "round trip {:.2f} s",
    keys.SLIP_RATIO: "slip {:.2f}",
}
"""What else is said, of an array the largest."""

_SHARE: Final = 0.14  # of the frame's height
_LEAST_WIDTH: Final = 240  # px; a narrower frame has no room for words
_LEAST: Final = 60  # px; a smaller frame stays as it is
_DARKNESS: Final = 0.25  # share of the frame's light that is left under the strip
_WHITE: Final[Colour] = (240, 242, 245)


def state_of(info: dict[str, Any]) -> str:
    """Which of `STATES` a step was in."""
    found = (state for state, (_, signs) in STATES.items() if any(info.get(sign, 0) > 0 for sign in signs))
    return next(found, "as proposed")


def words_of(info: dict[str, Any]) -> list[str]:
    """The state of a step, then the numbers that its info has."""
    told = {key: info[key] for key in WORDS if key in info}
    if told.get(keys.CBF_MARGIN) == 0.0:  # 0 is written where there is no h at all
        del told[keys.CBF_MARGIN]
    return [state_of(info), *(WORDS[key].format(max(np.ravel(told[key]), key=abs)) for key in told)]


def with_strip(frame: Pixels, infos: Sequence[dict[str, Any]], bounds: tuple[Array, Array] | None) -> Pixels:
    """A copy of a frame, shape (height, width, 3), with the strip over its lower edge; a small one as it is.

    `infos` are those of the reset and the steps, the newest last, at most `STEPS`; `bounds` the smallest and largest
    actions, shapes (m,), or None: no bars.
    """
    height, width = frame.shape[:2]
    if min(height, width) < _LEAST:
        return frame
    picture = np.array(frame[..., :3], dtype=np.uint8)
    tall = max(12, round(_SHARE * height))
    edge = max(2, tall // 12)
    strip = picture[height - tall :]
    strip[:] = (_DARKNESS * strip).astype(np.uint8)
    info = infos[-1] if infos else {}
    bars = 0
    if bounds is not None and keys.EXECUTED_ACTION in info:
        bars = min(width // 4, 2 * tall)
        _draw_bars(strip[edge : tall - edge + 1, width - bars : width - edge], info, bounds)
    words, right = tall // 2 if width >= _LEAST_WIDTH else 0, width - bars - 2 * edge
    if words:
        _write(strip[edge:words, edge:right], words_of(info))
    _draw_columns(strip[words + edge : tall - edge + 1, edge : right + 1], infos)
    return picture


def _write(area: Pixels, words: list[str]) -> None:
    """The state with its colour, then the numbers, as far as there is room."""
    from PIL import Image, ImageDraw, ImageFont  # here: who imports the library need not draw

    picture, tall = Image.fromarray(area), len(area)
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(size=max(9, round(0.6 * tall)))
    middle, x = tall / 2, tall // 4
    draw.ellipse((x, middle - tall / 4, x + tall / 2, middle + tall / 4), fill=STATES[words[0]][0])
    x += round(0.75 * tall)
    for word in words:
        room = max(draw.textlength(one, font) for one in (STATES if word in STATES else [word]))
        if x + room > picture.width:
            break
        draw.text((x, middle), word, fill=_WHITE, font=font, anchor="lm")
        x += round(room + 0.6 * tall)
    area[:] = np.asarray(picture)


def _draw_columns(area: Pixels, infos: Sequence[dict[str, Any]]) -> None:
    """One per step, the last one at the right: as high as the margin, in the colour of the state."""
    tall, wide = area.shape[:2]
    area[-1] = STATES["as proposed"][0]
    margins = np.abs([float(info.get(keys.CBF_MARGIN, 0.0)) for info in infos])
    shares = np.where(np.isfinite(margins), margins, 0.0)
    shares /= shares.max(initial=0.0) or 1.0
    for place, (info, share) in enumerate(zip(infos, shares, strict=True), STEPS - len(infos)):
        left, right = place * wide // STEPS, (place + 1) * wide // STEPS
        area[-max(3, round(share * tall)) :, left : max(left + 1, right)] = STATES[state_of(info)][0]


def _draw_bars(area: Pixels, info: dict[str, Any], bounds: tuple[Array, Array]) -> None:
    """Of every action, from its smallest to its largest value: the proposed one beside the executed one."""
    low, high = (bound[:MOST_BARS] for bound in bounds)
    wide = area.shape[1] / len(low)

    def rows(actions: Array) -> NDArray[np.int_]:
        shares = (np.ravel(actions)[:MOST_BARS] - low) / np.where(high > low, high - low, 1.0)
        return np.rint((len(area) - 1) * (1.0 - np.clip(shares, 0.0, 1.0))).astype(int)

    zeros = rows(np.zeros(len(low)))
    for (key, colour), start in zip(ACTIONS.items(), (0.08, 0.54), strict=True):
        if key not in info:  # a lease without a filter tells what was executed alone
            continue
        for i, (top, bottom) in enumerate(np.sort([rows(info[key]), zeros], axis=0).T):
            left, right = round((i + start) * wide), round((i + start + 0.38) * wide)
            area[max(top - 1, 0) : bottom + 2, left : right + 1] = colour
    for i, zero in enumerate(zeros):
        area[zero, round(i * wide) : round((i + 1) * wide - 1)] = _WHITE
