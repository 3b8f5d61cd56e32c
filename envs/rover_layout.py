"""Where everything stands when the rover's episode starts, how a user asks for it, and what a viewer sees of it."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import mujoco
import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.errors import ConfigurationError, UnknownNameError

from .goal_layout import Given, known, layout_option, numbers, place_objects, place_one, points
from .ground import GROUNDS, Patch

ROVER_LAYOUT_KEYS: Final = ("agent", "goal", "hazards", "patches", "ground", "speed")
"""What the rover's ``reset(options={"layout": {...}})`` understands."""
HALF_EXTENT: Final = 4.0
"""The field is the square [-4, 4]^2, m: objects are sampled in it; the rover may leave it."""
HAZARDS: Final = 6
"""Hazards in a sampled layout, and the most in a given one."""
SAMPLED_GROUNDS: Final = ("wet", "wet", "wet", "wet", "ice", "ice", "ice", "ice")
"""Grounds of the patches in a sampled layout; as many are the most in a given one."""

_PATCH_RADII: Final = (0.6, 1.0)  # m, uniform
_AGENT_KEEPOUT: Final = 0.7  # m: no two centres nearer than the sum of their keepouts
_GOAL_KEEPOUT: Final = 0.5
_HAZARD_KEEPOUT: Final = 0.4
_PATCH_KEYS: Final = ("ground", "center", "radius")


@dataclass(frozen=True)
class RoverLayout:
    """A whole layout.

    Attributes:
        agent: Position and heading, shape (3,), m and rad.
        goal: Centre, shape (2,), m.
        hazards: Centres, shape (n, 2), m.
        patches: Discs of another ground.
        ground: The ground everywhere else.
        speed: Of the rover along its heading at the start, its wheels rolling along, m/s.
    """

    agent: Array
    goal: Array
    hazards: Array
    patches: tuple[Patch, ...]
    ground: str
    speed: float


def parse_rover_layout(options: Mapping[str, Any] | None) -> Given:
    """Read the layout out of `reset`'s options; without a word the ground is dry and the speed 0.

    Given positions are taken as they are: no keepouts are enforced among them. Options other than ``"layout"``
    belong to wrappers and are left alone.

    Args:
        options: `reset`'s options; never changed.

    Raises:
        UnknownNameError: An unknown layout key, ground or patch key, or what looks like a misspelt ``"layout"``.
        ConfigurationError: A wrong shape, too many objects, or a number out of its range.
    """
    given = layout_option(options, ROVER_LAYOUT_KEYS)
    speed = numbers(given, "speed", "a number of m/s", ())
    ground = given.get("ground")
    return known(
        agent=numbers(given, "agent", "[x, y, heading]", (3,)),
        goal=numbers(given, "goal", "[x, y]", (2,)),
        hazards=points(given, "hazards", HAZARDS),
        patches=_patches(given["patches"]) if given.get("patches") is not None else None,
        ground="dry" if ground is None else _ground(ground),
        speed=0.0 if speed is None else float(speed),
    )


def sample_rover_layout(rng: np.random.Generator, given: Given) -> RoverLayout:
    """Sample what is missing of a layout; given parts are kept as they are.

    Agent, goal and hazards keep their keepouts from each other; patches lie anywhere, under whatever stands there,
    the icy ones on top.

    Args:
        rng: Source of randomness.
        given: The parts to keep.

    Raises:
        ConfigurationError: The given parts leave no room for the rest.
    """
    kinds = {
        "agent": (1, _AGENT_KEEPOUT),
        "goal": (1, _GOAL_KEEPOUT),
        "hazards": (HAZARDS, _HAZARD_KEEPOUT),
    }
    placed = place_objects(rng, HALF_EXTENT, kinds, given)
    patches = given["patches"] if "patches" in given else _sample_patches(rng)
    return RoverLayout(**placed, patches=patches, ground=given["ground"], speed=given["speed"])


def sample_rover_goal(rng: np.random.Generator, agent: Array, hazards: Array) -> Array:
    """Sample the next goal, shape (2,), m, beside the rover and the hazards.

    A crowded scenario must not end an episode with an error: where no try is clear, the clearest is taken.

    Args:
        rng: Source of randomness.
        agent: Rover's position, shape (2,), m.
        hazards: Centres, shape (n, 2), m.
    """
    placed = np.concatenate([agent[None], hazards])
    keepouts = np.repeat([_AGENT_KEEPOUT, _HAZARD_KEEPOUT], [1, len(hazards)])
    return place_one(rng, HALF_EXTENT, _GOAL_KEEPOUT, placed, keepouts)


def _sample_patches(rng: np.random.Generator) -> tuple[Patch, ...]:
    patches = []
    for ground in SAMPLED_GROUNDS:
        radius = float(rng.uniform(*_PATCH_RADII))
        x, y = rng.uniform(radius - HALF_EXTENT, HALF_EXTENT - radius, size=2).tolist()
        patches.append(Patch(ground, (x, y), radius))
    return tuple(patches)


def _patches(value: Any) -> tuple[Patch, ...]:
    if isinstance(value, str | Mapping) or not hasattr(value, "__iter__"):
        raise ConfigurationError(
            'layout \'patches\' must be a list of {"ground": name, "center": [x, y], "radius": m}; '
            f"got {value!r}"
        )
    patches = [_patch(item, f"patches[{i}]") for i, item in enumerate(value)]
    if len(patches) > len(SAMPLED_GROUNDS):
        raise ConfigurationError(
            f"layout gives {len(patches)} patches, but there are at most {len(SAMPLED_GROUNDS)}"
        )
    return tuple(patches)


def _patch(value: Any, where: str) -> Patch:
    if not isinstance(value, Mapping) or set(value) != set(_PATCH_KEYS):
        raise UnknownNameError(
            f"layout {where!r} must be a mapping with the keys {', '.join(_PATCH_KEYS)}; got {value!r}"
        )
    center = numbers(value, "center", "[x, y]", (2,))
    radius = numbers(value, "radius", "a number of m", ())
    if center is None or radius is None or radius <= 0.0:
        raise ConfigurationError(
            f"layout {where!r} must have a center [x, y] and a radius > 0 m; got {value!r}"
        )
    x, y = center.tolist()
    return Patch(_ground(value["ground"]), (x, y), float(radius))


def _ground(value: Any) -> str:
    if not (isinstance(value, str) and value in GROUNDS):
        raise UnknownNameError(f"unknown ground {value!r}: valid grounds are {', '.join(GROUNDS)}")
    return value


def start_state(layout: RoverLayout, rest: Array, velocities: int) -> tuple[Array, Array]:
    """Positions and velocities of the chassis, from the positions at rest; the wheels' are left as they are."""
    x, y, heading = layout.agent.tolist()
    qpos, qvel = rest.copy(), np.zeros(velocities)
    qpos[:2] = x, y
    qpos[3:7] = math.cos(0.5 * heading), 0.0, 0.0, math.sin(0.5 * heading)
    qvel[:2] = layout.speed * math.cos(heading), layout.speed * math.sin(heading)
    return qpos, qvel


_PARKED: Final = 1000.0  # m: farther than the rover gets in an episode
_COLOURS: Final = {
    "dry": (0.55, 0.5, 0.45, 0.6),
    "wet": (0.25, 0.35, 0.45, 0.6),
    "snow": (1.0, 1.0, 1.0, 0.9),
    "ice": (0.65, 0.9, 1.0, 0.9),
}


class Scene:
    """Markers of a model; none of them touches anything."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._floor = int(model.geom("floor").id)
        self._floor_colour = model.geom_rgba[self._floor].copy()
        self._patch_geoms = [g for g in range(model.ngeom) if model.geom(g).name.startswith("patch")]

    def show(self, model: mujoco.MjModel, data: mujoco.MjData, layout: RoverLayout) -> None:
        """Move hazards and patches where the layout has them."""
        mocap = data.mocap_pos
        mocap[1:, :2] = _PARKED
        n = len(layout.hazards)
        mocap[1 : 1 + n, :2] = layout.hazards
        first = len(mocap) - len(self._patch_geoms)
        for i, (patch, geom) in enumerate(zip(layout.patches, self._patch_geoms, strict=False)):
            mocap[first + i, :2] = patch.center
            model.geom_size[geom, 0] = model.geom_rbound[geom] = patch.radius
            model.geom_rgba[geom] = _COLOURS[patch.ground]
        bare = layout.ground == "dry"
        model.geom_rgba[self._floor] = self._floor_colour if bare else (*_COLOURS[layout.ground][:3], 1.0)
