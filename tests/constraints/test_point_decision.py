"""The compiled search of a point mass among walls: the general search is its oracle."""

import hashlib
import math
import warnings

import numpy as np
import pytest
from point_worlds import PointWorld

import safe_wrappers as sw
from safe_wrappers.control.backup import point_decision
from safe_wrappers.control.backup.damped_axis import damped_axis
from safe_wrappers.filter.engine import SafetyFilter

WALLS = [(-3.0, 3.0, -3.0, -2.0), (-3.0, 3.0, 2.0, 3.0), (-3.0, -2.0, -2.0, 2.0), (2.0, 3.0, -2.0, 2.0)]
BLOCKS = [(-0.5, 0.5, -0.5, 0.4), (0.9, 1.2, -0.1, 0.9)]


class Searched(sw.constraints.WallClearance):
    """The same constraint, left to the general search."""

    def bind(self, plant):
        bound = super().bind(plant)
        bound.decides = False
        return bound


@pytest.mark.parametrize("substeps", [1, 4])
@pytest.mark.parametrize("options", [{"velocity_clip": 5.0}, {}, {"margin": 0.2}])
def test_the_stage_and_the_control_are_those_of_the_general_search(options, substeps):
    env = sw.CBFActionFilter(PointWorld(substeps, clip=5.0), [sw.constraints.WallClearance(**options)])
    low, high = (end.astype(np.float64) for end in (env.action_space.low, env.action_space.high))
    box = low, high, env.action_space.dtype
    searched = SafetyFilter(env.plant, [Searched(**options)], "brake", *box)
    rng, stages = np.random.default_rng(3), []
    for episode in range(12):
        env.reset(seed=episode)
        # Also from inside the margin and too fast to stop.
        env.unwrapped.place(rng.uniform(-1.8, 1.8, 2), rng.uniform(-4.0, 4.0, 2))
        with warnings.catch_warnings(action="ignore"):
            for one in (env.filter, searched):
                one.start()
        for k in range(60):
            if k % 10 == 0:
                proposal = rng.choice([low, high, [0.4, 0.0], [0.0, -0.3]])
            decisions = []
            for one in (env.filter, searched):
                one.observe()
                decisions.append(one.filter(proposal))
            by_itself, general = decisions
            assert by_itself.stage == general.stage
            assert (by_itself.control == general.control).all()
            assert by_itself.changed == general.changed and by_itself.infeasible == general.infeasible
            stages.append(int(by_itself.stage))
            env.env.step(by_itself.control)
            for one in (env.filter, searched):
                one.executed(by_itself.control)
    assert stages.count(point_decision.PROPOSAL) > 50 and stages.count(point_decision.CANDIDATE) > 50


def random_scenes(count):
    """Every function on random scenes, as one digest, and how often which stage answered."""
    rng, digest, stages = np.random.default_rng(11), hashlib.sha256(), []
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
        asked = motion, left, control.copy()
        found = [
            left,
            motion,
            point_decision.is_admitted(scene, *asked),
            point_decision.candidates(scene, *asked),
        ]
        away = np.linalg.norm(found[3] - control, axis=1)
        assert (np.diff(away) >= -1e-9).all()  # the nearest candidate first
        found += [
            *point_decision.half_spaces(scene, *asked[:2]),
            point_decision.backup_pair(scene, *asked[:2]),
        ]
        stages.append(point_decision.closest_admitted(scene, *asked[:2], low, high, control))
        for part in (*found, stages[-1], control):
            digest.update(np.asarray(part, dtype=np.float64).tobytes())
    return digest.hexdigest(), [stages.count(stage) for stage in range(8)]


def test_the_random_scenes_have_everything_in_them():
    _, stages = random_scenes(800)
    assert stages[point_decision.PROPOSAL] > 10 and stages[point_decision.CANDIDATE] > 10
