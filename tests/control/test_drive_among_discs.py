"""The compiled search of a heading drive among discs: the general search is its oracle."""

import dataclasses
import hashlib

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from benchmarks import drivers
from safe_wrappers.constraints.backup.heading_drive_clearance import BoundHeadingDriveClearance
from safe_wrappers.control.backup import drive_decision as among
from safe_wrappers.control.numerics.projection import cast_inside
from safe_wrappers.filter.engine import SafetyFilter

RESERVE_M = 0.004
KINDS = {
    "detour": {"detour": True},
    "no detour": {},
    "uncertain": {"detour": True, "uncertainty": 0.2},
}


class Searched(sw.constraints.HeadingDriveClearance):
    """The same constraint, left to the general search."""

    def bind(self, plant):
        bound = super().bind(plant)
        bound.decides = False
        return bound


def general_search(env):
    """A filter of the same plant that searches."""
    (spec,) = env.constraints
    space = env.action_space
    same = Searched(
        **{field.name: getattr(spec, field.name) for field in dataclasses.fields(spec) if field.init}
    )
    low, high = space.low.astype(float), space.high.astype(float)
    # In double precision: rounding would hide what differs, and where it is a tie make a difference of its own.
    env.filter = SafetyFilter(env.plant, env.constraints, "brake", low, high)
    env.filter.start()
    return SafetyFilter(env.plant, [same], "brake", low, high)


def both(env, searched, proposal):
    """The decision of the constraint itself, which is executed, and that of the search."""
    decisions = []
    for one in (env.filter, searched):
        one.observe()
        decisions.append(one.filter(proposal))
    env.env.step(decisions[0].control)
    for one in (env.filter, searched):
        one.executed(decisions[0].control)
    return decisions


def episode(options, driver, steps, seed):
    """Stages and executed controls of both searches in the same states; the first one's are executed."""
    clearance = sw.constraints.HeadingDriveClearance(
        [sw.constraints.Discs("hazard_positions", 0.2)], **options
    )
    env = sw.CBFActionFilter(gym.make("SafePointGoal1-v0"), [clearance])
    env.reset(seed=seed)
    act = drivers.DRIVERS[driver](env.unwrapped, np.random.default_rng(seed))
    searched = general_search(env)
    searched.start()
    for _ in range(steps):
        yield both(env, searched, np.asarray(act(), dtype=np.float64))


@pytest.mark.parametrize("driver", ["hazard-seeking", "bang-bang"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_stage_and_the_control_are_those_of_the_general_search(kind, driver):
    seen = set()
    for by_itself, general in episode(KINDS[kind], driver, 900, seed=1):
        assert by_itself.stage == general.stage
        np.testing.assert_allclose(by_itself.control, general.control, atol=1e-9)
        assert by_itself.changed == general.changed and not by_itself.infeasible
        seen.add(int(by_itself.stage))
    assert among.PROPOSAL in seen and len(seen) >= 2


def test_from_inside_a_disc_both_searches_lead_out():
    clearance = sw.constraints.HeadingDriveClearance([sw.constraints.Disc([0.0, 0.0], 0.3)])
    layout = {"agent": [0.1, 0.05, 0.4], "goal": [1.2, 1.2], "hazards": [[1.0, -1.0]], "vases": []}
    rng, changed = np.random.default_rng(0), 0
    env = sw.CBFActionFilter(gym.make("SafePointGoal1-v0"), [clearance])
    with pytest.warns(sw.UnsafeStateWarning):
        env.reset(seed=0, options={"layout": layout})
    searched = general_search(env)
    searched.start()
    for _ in range(60):
        decisions = both(env, searched, rng.uniform(-1.0, 1.0, 2))
        assert decisions[0].stage == decisions[1].stage
        np.testing.assert_allclose(decisions[0].control, decisions[1].control, atol=1e-9)
        changed += decisions[0].changed
    assert changed > 5
    with pytest.warns(sw.UnsafeStateWarning):
        env.reset(seed=0, options={"layout": layout})
    values = []
    for _ in range(60):  # the backup alone leads out, too, and stays out
        env.filter.observe()
        control = env.filter.bound[0].backup()
        values.append(float(env.filter.bound[0].value()[0]))
        env.env.step(control)
        env.filter.executed(control)
    assert values[0] < -0.2 and values[-1] > 0.05 and np.diff(values).min() > -1e-3


def together(scenes, bounds, single):
    """Least clearances, verdicts, controls and stages of scenes that are alike in `detour`."""
    models, motions, discs, controls = (np.array([s[k] for s in scenes]) for k in (0, 1, 2, 3))
    detour, n = scenes[0][4], len(scenes)
    first = np.arange(n + 1) * len(scenes[0][2])
    scene = models, motions, np.concatenate(discs), first, RESERVE_M, controls
    least, admitted, out, stages = np.empty(n), np.empty(n, bool), controls.copy(), np.zeros(n, np.int64)
    among.admit_each(*scene, least, admitted)
    refused = np.flatnonzero(~admitted)
    corners = np.broadcast_to(bounds, (len(refused), 4, 2)).copy()
    among.decide_each(*scene, refused, np.zeros(n), detour, corners, single, out, stages)
    return least, admitted, out, stages


def random_scenes(count):
    """Every function on random scenes, as one digest."""
    rng, digest = np.random.default_rng(8), hashlib.sha256()
    env = sw.CBFActionFilter(
        gym.make("SafePointGoal1-v0"),
        [sw.constraints.HeadingDriveClearance([sw.constraints.Disc([0.0, 0.0], 0.2)], uncertainty=0.1)],
    )
    env.reset(seed=0)
    bound = env.filter.bound[0]
    assert isinstance(bound, BoundHeadingDriveClearance)
    every = np.array([bound.drive, *bound.drive.corners()], dtype=np.float64)
    certain = every.copy()
    certain[:, 12] = 0.0
    bounds, out, stages = np.array([[-1.0, -1.0], [1.0, 1.0], [-0.05, -1.0], [0.05, 1.0]]), np.empty(2), set()
    for i in range(count):
        models = certain[[0, 0]] if i % 2 else every
        motion = rng.uniform(-1.0, 1.0, 6) * [0.1, 0.1, 3.0, 1.0, 1.0, 2.0]
        state = motion[:3], motion[3:], np.zeros(4)
        discs = np.column_stack([rng.uniform(-0.9, 0.9, (6, 2)), np.full(6, 0.1)])
        control = rng.uniform(-1.0, 1.0, 2)
        scene = models, motion, discs, RESERVE_M
        numbers = among.closest_admitted(scene, control, 0.0, bool(i % 5), bounds, out)
        stages.add(numbers[0])
        for part in (
            *numbers,
            out,
            *among.least_clearance(*state, (models, np.empty(6), discs, RESERVE_M)),
        ):
            digest.update(np.asarray(part, dtype=np.float64).tobytes())
        digest.update(np.float64(among.manoeuvre_drive(scene)).tobytes())
        for part in together([(models, motion, discs, control, bool(i % 5))], bounds, single=True):
            digest.update(part.tobytes())
    return digest.hexdigest(), sorted(stages)


def test_the_random_scenes_have_everything_in_them():
    _, stages = random_scenes(3200)
    assert {among.PROPOSAL, among.ROWS, among.CANDIDATE, among.BACKUP, among.UNRESOLVED} <= set(stages)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_many_are_decided_as_each_alone_and_rounded_as_the_filter_rounds(dtype):
    env = sw.protect(gym.make("SafePointGoal1-v0"))
    drive = env.filter.bound[0].drive
    models = np.array([drive, *drive.corners()], dtype=np.float64)
    rng, bounds, found = np.random.default_rng(3), np.array([[-1.0, -1.0], [1.0, 1.0]] * 2), np.empty(2)
    scenes = []
    for _ in range(400):
        motion = rng.uniform(-1.0, 1.0, 6) * [0.1, 0.1, 3.0, 1.0, 1.0, 2.0]
        discs = np.column_stack([rng.uniform(-0.9, 0.9, (6, 2)), np.full(6, 0.1)])
        scenes.append((models, motion, discs, rng.uniform(-1.0, 1.0, 2), True))
    least, admitted, out, stages = together(scenes, bounds, dtype == np.float32)
    for i, (_, motion, discs, control, detour) in enumerate(scenes):
        seen = np.empty(6)
        state = motion[:3], motion[3:], np.zeros(4)
        assert least[i] == among.least_clearance(*state, (models, seen, discs, RESERVE_M))[0]
        scene = models, motion, discs, RESERVE_M
        assert admitted[i] == among.is_admitted(scene, *control)
        stage, _, *rows = among.closest_admitted(scene, control, 0.0, detour, bounds, found)
        assert stage == stages[i]
        if stage != among.PROPOSAL:
            sent = cast_inside(found, np.dtype(dtype), *rows, *bounds[:2])
            np.testing.assert_array_equal(out[i], sent.astype(np.float64))
        else:
            np.testing.assert_array_equal(out[i], control)
    assert {among.PROPOSAL, among.ROWS, among.CANDIDATE} <= set(stages.tolist())
