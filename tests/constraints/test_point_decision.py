"""What is compiled for a point mass among walls: of refused controls the nearest admitted ones."""

import hashlib
import math

import numpy as np

from safe_wrappers.control.backup import point_decision
from safe_wrappers.control.backup.damped_axis import damped_axis

WALLS = [(-3.0, 3.0, -3.0, -2.0), (-3.0, 3.0, 2.0, 3.0), (-3.0, -2.0, -2.0, 2.0), (2.0, 3.0, -2.0, 2.0)]
BLOCKS = [(-0.5, 0.5, -0.5, 0.4), (0.9, 1.2, -0.1, 0.9)]


def random_scenes(count):
    """Every function on random scenes, as one digest, and how many refused controls have an admitted one near."""
    rng, near, digest = np.random.default_rng(11), 0, hashlib.sha256()
    low, high = np.array([-1.0, -0.7]), np.array([1.0, 0.9])
    for i in range(count):
        substeps, clip_known = (1, 4)[i % 2], bool(i % 3)
        clip = 5.0 if clip_known else math.inf
        axes = (
            damped_axis(0.998, 0.24 / substeps, 0.01, substeps, low[0], high[0], clip),
            damped_axis(0.99, 0.2 / substeps, 0.01, substeps, low[1], high[1], clip),
        )
        scene = point_decision.scene(
            axes, (0.1, -0.2), (1, 0), (0, 1), rng.uniform(0.05, 0.3), clip_known, WALLS + BLOCKS
        )
        motion, qpos, qvel = np.zeros(4), rng.uniform(-1.9, 1.9, 2), rng.uniform(-5.5, 5.5, 2)
        left = point_decision.room_left(scene, qpos, qvel, motion)
        control = rng.uniform(low, high)
        found = point_decision.candidates(scene, motion, left, control)
        assert (np.diff(np.linalg.norm(found - control, axis=1)) >= -1e-9).all()
        refused = not point_decision.is_admitted(scene, motion, left, control)
        near += refused and len(found) > 0 and point_decision.is_admitted(scene, motion, left, found[0])
        half_spaces = point_decision.half_spaces(scene, motion, left)
        for part in (left, motion, found, *half_spaces, point_decision.backup_pair(scene, motion, left)):
            digest.update(np.asarray(part, dtype=np.float64).tobytes())
    return digest.hexdigest(), int(near)


def test_of_a_refused_control_the_nearest_candidate_comes_first_and_is_admitted():
    assert random_scenes(800)[1] > 10
