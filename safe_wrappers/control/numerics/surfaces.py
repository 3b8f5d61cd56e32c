"""The nearest points of planes, balls, upright cylinders and blocks, as seen from one point.

A surface is a row of eight numbers: its kind, its number of coordinates, and two triples. A PLANE has a point and the
unit normal into free space; a ROUND one its centre and, first of the second triple, its radius; a BLOCK its centre
and half of its sides. What has fewer coordinates than the point reaches along the others without end.
"""

import math
from typing import Final

import numpy as np

from safe_wrappers.checks import Array
from safe_wrappers.control.numerics.compiled import compiled

PLANE: Final = 0.0
ROUND: Final = 1.0
BLOCK: Final = 2.0
NUMBERS: Final = 8
"""Of one surface."""
_AT_THE_CENTRE: Final = 1e-12
"""m; closer to the centre of a round one every way out is as good."""


@compiled
def nearest_points(surfaces: Array, point: Array) -> tuple[Array, Array, Array]:
    """Signed distances, m, normals towards the point, and curvatures of the surfaces of equal distance, 1/m.

    Args:
        surfaces: Shape (k, 8).
        point: Shape (d,), m; d is at least each surface's number of coordinates.

    Returns:
        Shapes (k,), (k, d) and (k, d); the curvature is along each coordinate.
    """
    k, d = len(surfaces), len(point)
    distance, normal, curvature = np.zeros(k), np.zeros((k, d)), np.zeros((k, d))
    for i in range(k):
        kind, n = surfaces[i, 0], int(surfaces[i, 1])
        if kind == PLANE:
            for j in range(n):
                normal[i, j] = surfaces[i, 5 + j]
                distance[i] += normal[i, j] * (point[j] - surfaces[i, 2 + j])
            continue
        square, deepest, face = 0.0, -math.inf, 0
        for j in range(n):
            beyond = offset = point[j] - surfaces[i, 2 + j]
            if kind == BLOCK:
                beyond = abs(offset) - surfaces[i, 5 + j]
                if beyond > deepest:
                    deepest, face = beyond, j
                beyond = 0.0 if beyond < 0.0 else -beyond if offset < 0.0 else beyond
            normal[i, j] = beyond
            square += beyond * beyond
        length = math.sqrt(square)
        if kind == ROUND:
            distance[i] = length - surfaces[i, 5]
            for j in range(n):
                normal[i, j] /= length if length > _AT_THE_CENTRE else 1.0
                curvature[i, j] = 1.0 / (1e-9 if length < 1e-9 else length)
            if length <= _AT_THE_CENTRE:
                normal[i, 0] = 1.0
        elif length > 0.0:
            distance[i] = length
            sides = 0
            for j in range(n):
                sides += normal[i, j] != 0.0
            for j in range(n):
                if sides > 1 and normal[i, j] != 0.0:
                    curvature[i, j] = 1.0 / length
                normal[i, j] /= length
        else:
            distance[i] = deepest if length == 0.0 else length  # the length may be no number
            for j in range(n):
                normal[i, j] = 0.0
            normal[i, face] = -1.0 if point[face] < surfaces[i, 2 + face] else 1.0
    return distance, normal, curvature
