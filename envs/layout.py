"""How a user asks for where everything stands, and random places for the rest.

Random placement keeps keepouts: no two objects are nearer than the sum of theirs.
"""

import difflib
from collections.abc import Collection, Mapping
from typing import Any, Final

import numpy as np

from safe_wrappers.errors import Array, ConfigurationError, UnknownNameError

Given = Mapping[str, Any]
"""The parts of a layout that are fixed, arrays by name; what is missing is sampled."""
Form = tuple[str, tuple[int, ...]]
"""What is expected, in words, and its shape; (-8, 2) is at most 8 points."""
POSE: Final[Form] = "[x, y, heading]", (3,)
PLACE: Final[Form] = "[x, y]", (2,)

_TRIES_PER_OBJECT: Final = 100
_TRIES_PER_LAYOUT: Final = 1000


def places(at_most: int) -> Form:
    """That many points in the plane, or fewer."""
    return "[[x, y], ...]", (-at_most, 2)


def layout_option(options: Mapping[str, Any] | None, keys: Collection[str]) -> Given:
    """The layout among `reset`'s options, its keys checked, as given; empty when there is none."""
    options = options or {}
    for key in options:
        if key != "layout" and difflib.get_close_matches(str(key), ["layout"], cutoff=0.7):
            raise UnknownNameError(f"unknown reset option {key!r}: did you mean 'layout'?")
    given = options.get("layout")
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise ConfigurationError(
            f"options['layout'] must be a mapping with keys among {', '.join(keys)}; got {type(given).__name__}"
        )
    for key in given:
        if key not in keys:
            raise UnknownNameError(f"unknown layout key {key!r}: valid keys are {', '.join(keys)}")
    return {key: value for key, value in given.items() if value is not None}


def parse_layout(options: Mapping[str, Any] | None, forms: Mapping[str, Form]) -> dict[str, Array]:
    """Read a layout of numbers out of `reset`'s options, as `layout_option` does.

    Given positions are taken as they are: no keepouts are enforced among them, so a scenario may start inside a
    hazard.

    Raises:
        UnknownNameError: An unknown key in the layout, or an option that looks like a misspelt ``"layout"``.
        ConfigurationError: A wrong shape, too many objects, or a number that is not finite.
    """
    given = layout_option(options, forms)
    return {key: numbers(value, key, forms[key]) for key, value in given.items()}


def numbers(value: Any, key: str, form: Form) -> Array:
    """Finite numbers of a form."""
    words, shape = form
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ConfigurationError(f"layout {key!r} must be {words}; got {value!r}") from error
    if not np.isfinite(array).all():
        raise ConfigurationError(f"layout {key!r} must be finite; got {array.tolist()}")
    if shape and shape[0] <= 0:
        array = array if array.size else np.zeros((0, 2))
        if array.ndim == 2 and len(array) > -shape[0]:
            raise ConfigurationError(
                f"layout gives {len(array)} {key}, but there is room for at most {-shape[0]}"
            )
        shape = (len(array), *shape[1:]) if array.ndim else shape
    if array.shape != shape:
        raise ConfigurationError(f"layout {key!r} must be {words}; got shape {array.shape}")
    return array


def place_goal_beside(
    rng: np.random.Generator, half_extent: float, keepouts: Mapping[str, float], standing: Mapping[str, Array]
) -> Array:
    """Place the next goal, shape (2,), m, in the field [-half_extent, half_extent]^2, m, beside centres by name.

    A crowded scenario must not end an episode with an error: where no try is clear, the clearest is taken.
    """
    return _clearest(rng, half_extent, keepouts["goal"], *_circles(keepouts, standing))[0]


def place_objects(
    rng: np.random.Generator,
    half_extent: float,
    keepouts: Mapping[str, float],
    counts: Mapping[str, int],
    given: Given,
) -> dict[str, Array]:
    """Place the objects that do not stand yet, kind by kind, and turn the robot anywhere.

    Returns centres by name, shapes (n, 2), m; of the goal shape (2,), of the agent its pose, (3,), m and rad. An
    object with keepout k is drawn uniformly from the field [-half_extent, half_extent]^2 shrunk by k, until it is at
    least k + k' away from every object placed before, m. `keepouts` are in the order in which kinds are placed,
    `counts` one where nothing is said; what is `given` stands and is kept.

    Raises:
        ConfigurationError: What stands leaves no room for the rest.
    """
    standing = {name: given[name] for name in keepouts if name in given}
    standing |= {name: given[name][None, :2] for name in ("agent", "goal") if name in given}
    for _ in range(_TRIES_PER_LAYOUT):
        centres = _try_objects(rng, half_extent, keepouts, counts, standing)
        if centres is not None:
            heading = rng.uniform(-np.pi, np.pi) if "agent" not in given else given["agent"][2]
            pose = np.append(centres["agent"][0], heading)
            return centres | {"agent": pose, "goal": centres["goal"][0]}
    raise ConfigurationError(
        f"no room for the objects left to sample in the field [-{half_extent}, {half_extent}]^2:"
        " give fewer objects, or all positions"
    )


def _try_objects(
    rng: np.random.Generator,
    half_extent: float,
    keepouts: Mapping[str, float],
    counts: Mapping[str, int],
    standing: Mapping[str, Array],
) -> dict[str, Array] | None:
    centres = {name: centre.copy() for name, centre in standing.items()}
    placed, kept = _circles(keepouts, standing)
    for name in [name for name in keepouts if name not in centres]:
        first = len(placed)
        for _ in range(counts.get(name, 1)):
            point, slack = _clearest(rng, half_extent, keepouts[name], placed, kept)
            if slack < 0.0:
                return None
            placed, kept = np.concatenate([placed, point[None]]), np.append(kept, keepouts[name])
        centres[name] = placed[first:].copy()
    return centres


def _circles(keepouts: Mapping[str, float], standing: Mapping[str, Array]) -> tuple[Array, Array]:
    """Centres of everything that stands, shape (n, 2), and how far it keeps others off, shape (n,), m."""
    kept = [np.full(len(centres), keepouts[name]) for name, centres in standing.items()]
    return np.concatenate([np.zeros((0, 2)), *standing.values()]), np.concatenate([np.zeros(0), *kept])


def _clearest(
    rng: np.random.Generator, half_extent: float, keepout: float, placed: Array, kept: Array
) -> tuple[Array, float]:
    """The first random point that is clear of what stands, else the clearest; distance left over there, m."""
    best, best_slack, reach = np.zeros(2), -np.inf, half_extent - keepout
    for _ in range(_TRIES_PER_OBJECT):
        point = rng.uniform(-reach, reach, size=2)
        gaps = np.hypot(placed[:, 0] - point[0], placed[:, 1] - point[1]) - kept - keepout
        slack = float(gaps.min(initial=np.inf))
        if slack > best_slack:
            best, best_slack = point, slack
        if slack >= 0.0:
            break
    return best, best_slack
