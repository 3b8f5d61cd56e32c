"""How obstacles look, grown by what is kept free before them: where the machine's point may not be."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.constraints.obstacles import Box, Disc, Discs, Plane, Sphere, TrackedDiscs
from safe_wrappers.drawing.marks import Mark, ball, block, ellipsoid, pad, ring, spatial
from safe_wrappers.plants.plant import Plant

_PAD_M: Final = 0.4
"""Half of the square that is drawn of a plane."""


def obstacle_marks(obstacles: Sequence[Any], plant: Plant, inset: float, point: Array) -> list[Mark]:
    """Marks of obstacles, each larger by an inset, m; of a plane the part nearest to a point of 1 to 3 coordinates.

    An obstacle of another kind than the library's is not drawn.
    """
    found: list[Mark] = []
    for obstacle in obstacles:
        if isinstance(obstacle, Disc | Discs | Sphere):
            centers, radius = obstacle.centers(plant), obstacle.radius + inset
            if centers.shape[1] == 2:
                found += [mark for center in centers for mark in ring("limit", center, radius)]
            else:
                found += [ball("keep out", center, radius) for center in centers]
        elif isinstance(obstacle, Box):
            found.append(block("keep out", obstacle.center, np.array(obstacle.half_size) + inset))
        elif isinstance(obstacle, Plane):
            normal = spatial(obstacle.normal, 0.0)
            at, of = spatial(point), spatial(obstacle.point, 0.0)
            foot = at - ((at - of) @ normal - inset) * normal
            found.append(pad("keep out", foot, normal, _PAD_M))
        elif isinstance(obstacle, TrackedDiscs):
            tracks = obstacle.tracks(plant)
            bounds = zip(tracks.positions, tracks.position_covariances, strict=True)
            radius = obstacle.radius + inset
            found += [ellipsoid("estimate", p, cov, obstacle.sigmas, radius) for p, cov in bounds]
    return found
