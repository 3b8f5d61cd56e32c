"""A heading drive among discs: from inside of one the backup leads out, and random scenes have an answer."""

import hashlib

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.control.backup import drive_among_discs as among

RESERVE_M = 0.004


def test_from_inside_a_disc_the_filter_and_the_backup_alone_lead_out():
    clearance = sw.constraints.HeadingDriveClearance([sw.constraints.Disc([0.0, 0.0], 0.3)])
    layout = {"agent": [0.1, 0.05, 0.4], "goal": [1.2, 1.2], "hazards": [[1.0, -1.0]], "vases": []}
    rng = np.random.default_rng(0)
    env = sw.CBFActionFilter(gym.make("SafePointGoal1-v0"), [clearance])
    for policy in (lambda: rng.uniform(-1.0, 1.0, 2), None):
        with pytest.warns(sw.UnsafeStateWarning):
            env.reset(seed=0, options={"layout": layout})
        values, changed = [], 0
        for _ in range(60):
            env.filter.observe()
            values.append(float(env.filter.bound[0].value()[0]))
            if policy is None:
                control = env.filter.bound[0].backup()
            else:
                decision = env.filter.filter(policy())
                control, changed = decision.control, changed + decision.changed
            env.env.step(control)
            env.filter.executed(control)
        assert values[0] < -0.2 and values[-1] > 0.05 and np.diff(values).min() > -1e-3
        assert changed > 5 or policy is None


def random_scenes(count):
    """Every function on random scenes, as one digest, and how many controls are admitted."""
    env = sw.CBFActionFilter(
        gym.make("SafePointGoal1-v0"),
        [sw.constraints.HeadingDriveClearance([sw.constraints.Disc([0.0, 0.0], 0.2)], uncertainty=0.1)],
    )
    env.reset(seed=0)
    drive = env.filter.bound[0].spec.drive
    rng, models = np.random.default_rng(3), np.array([drive, *drive.corners()], dtype=np.float64)
    motions = rng.uniform(-1.0, 1.0, (count, 6)) * [0.1, 0.1, 3.0, 1.0, 1.0, 2.0]
    discs = np.dstack([rng.uniform(-0.9, 0.9, (count, 6, 2)), np.full((count, 6), 0.1)])
    controls = rng.uniform(-1.0, 1.0, (count, 2))
    admitted, digest = np.empty(count, dtype=bool), hashlib.sha256()
    for i in range(count):
        scene = models, motions[i], discs[i], RESERVE_M
        admitted[i] = among.is_admitted(scene, *controls[i])
        joints = motions[i, :3], motions[i, 3:], np.zeros(4)
        least = among.least_clearance(*joints, (models, np.empty(6), discs[i], RESERVE_M))[0]
        found = (
            *among.secants(scene),
            among.way_around(scene, *controls[i], 0.0),
            among.manoeuvre_drive(scene),
        )
        for part in (least, admitted[i], *found):
            digest.update(np.asarray(part, dtype=np.float64).tobytes())
    return digest.hexdigest(), int(admitted.sum())


def test_some_controls_of_random_scenes_are_admitted_and_some_are_not():
    assert 40 < random_scenes(400)[1] < 360
