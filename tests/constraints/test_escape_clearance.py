"""EscapeClearance against MuJoCo: every way out played on the env's model, the cars on their foretold paths."""

import copy

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from asking import Asked

import safe_wrappers as sw

HOLD, RADIUS, CAR, PILLAR, MARGIN = 0.04, 0.2, 0.4, 0.35, 0.05
TRUE_CARS = sw.constraints.TrackedDiscs(CAR, 0.0, attribute="car_tracks")
PILLARS = sw.constraints.Discs("pillar_positions", PILLAR)
WAYS = [(0, 0, 0), *((x, y, n) for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)) for n in (8, 20))]


def bound(obstacles, delay_s=0.0, horizon_s=2.5, margin=MARGIN, env=None):
    env = gym.make("OccludedCrossing-v0") if env is None else env
    env.reset(seed=0)
    plant = sw.MujocoPlant(delay_s=delay_s)
    plant.bind(env)
    clearance = Asked(sw.constraints.EscapeClearance("robot", obstacles, RADIUS, margin, horizon_s), plant)
    return env.unwrapped, plant, clearance


def anew(raw, plant, clearance, qpos, qvel):
    raw.set_state(np.asarray(qpos, dtype=float), np.asarray(qvel, dtype=float))
    clearance.start()
    plant.observe()


class Played:
    """The env's own model, without contacts, driven hold by hold."""

    def __init__(self, model, mass=1.0):
        self.model = copy.copy(model)
        self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        self.model.body_mass *= mass
        self.data = mujoco.MjData(self.model)

    def hold(self, control):
        self.data.ctrl[:2] = control
        for _ in range(4):
            mujoco.mj_step(self.model, self.data)

    def brake(self):
        """The control that ends the hold at rest, as far as there is one: both ends tried, and between them."""
        spec = mujoco.mjtState.mjSTATE_INTEGRATION
        kept = np.zeros(mujoco.mj_stateSize(self.model, spec))
        mujoco.mj_getState(self.model, self.data, kept, spec)
        ends = []
        for control in (-1.0, 1.0):
            self.hold([control, control])
            ends.append(self.data.qvel[:2].copy())
            mujoco.mj_setState(self.model, self.data, kept, spec)
        share = ends[0] / (ends[0] - ends[1])
        return np.clip(-1.0 + 2.0 * share, -1.0, 1.0)

    def positions(self, qpos, qvel, control, way, holds):
        """At the end of the control's hold, and of each one of the way's."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = qpos, qvel
        self.hold(np.clip(control, -1, 1))
        places = [self.data.qpos[:2].copy()]
        for k in range(holds):
            self.hold(way[:2] if k < way[2] else self.brake())
            places.append(self.data.qpos[:2].copy())
        return np.array(places)


def foretold(qpos, qvel, times):
    """The cars' centres some times ahead: back to their mean speed with 2 s."""
    mean = np.repeat([1.0, -1.0], 3)
    kept = np.exp(-times / 2.0)[:, None]
    x = qpos[3:] + mean * times[:, None] + 2.0 * (1.0 - kept) * (qvel[3:] - mean)
    return np.stack([x, np.broadcast_to(np.repeat([-0.8, 0.8], 3), x.shape)], axis=-1)


def left(played, raw, qpos, qvel, control, wanted):
    """What the best of the nine ways out leaves."""
    times = HOLD * (1 + np.arange(64))
    cars = foretold(qpos, qvel, times)
    best = []
    for way in WAYS:
        places = played.positions(qpos, qvel, control, way, 62)[::2]
        to_cars = np.linalg.norm(places[:, None] - cars[:63:2], axis=-1).min(axis=1) - CAR - RADIUS
        to_pillars = np.linalg.norm(places[:, None] - raw.pillar_positions, axis=-1).min(axis=1)
        best.append((np.minimum(to_cars, to_pillars - PILLAR - RADIUS) - wanted).min())
    return max(best)


def random_states(count, seed=0):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        qpos = np.concatenate([rng.uniform([-2, -1.8, -3], [2, 1.8, 3]), rng.uniform(-5, 5, 6)])
        qvel = np.concatenate([rng.uniform([-2, -2, -4], [2, 2, 4]), np.repeat([1, -1], 3)])
        qvel[3:] += rng.normal(size=6) * 0.15
        qpos[3::3] = qpos[0] + rng.uniform(-2, 2, 2)  # one of each lane not far away
        yield qpos, qvel, rng.uniform(-1.3, 1.3, 3)


def test_what_is_left_is_what_mujoco_leaves():
    raw, plant, clearance = bound([TRUE_CARS, PILLARS])
    played, agreed, refused = Played(raw.model), 0, 0
    for qpos, qvel, control in random_states(30):
        anew(raw, plant, clearance, qpos, qvel)
        now = clearance.value()
        cars = np.linalg.norm(raw.car_positions - qpos[:2], axis=1) - CAR - RADIUS
        pillars = np.linalg.norm(raw.pillar_positions - qpos[:2], axis=1) - PILLAR - RADIUS
        np.testing.assert_allclose(now, [*cars, *pillars], atol=1e-12)
        if now.min() < MARGIN:
            continue
        expected = left(played, raw, qpos, qvel, control[:2], MARGIN)
        slack = clearance.slack(control)
        if expected >= 0.0:  # where nothing is near it only says that there is room
            assert slack >= expected - 1e-7
            agreed += 1
        else:
            # What the margin is there for: the best first control may use it up, and another one no more than that.
            mujoco.mj_resetData(played.model, played.data)
            played.data.qpos[:], played.data.qvel[:] = qpos, qvel
            firsts = [played.brake(), [1, 0], [-1, 0], [0, 1], [0, -1]]
            best = max(left(played, raw, qpos, qvel, np.array(first), MARGIN) for first in firsts)
            needed = best if -MARGIN < best < 0.0 else 0.0
            assert slack == pytest.approx(expected - needed, abs=1e-7)
            refused += 1
        assert clearance.admits(control) == (slack >= -1e-9)
    assert agreed > 8 and refused > 2, (agreed, refused)


class Rolling(gym.Wrapper):
    """A large ball rolls across the place of the robot, below a wall; it is published."""

    rolling = np.array([[2.0, 0.0, 9.0]])

    def step(self, action):
        self.balls = self.balls + HOLD * self.rolling
        return super().step(action)


def test_a_way_out_that_was_begun_stays_open_until_its_end():
    """21 holds up and then braking lead between ball and wall; one hold more or less is too much or too little."""
    env = Rolling(gym.make("OccludedCrossing-v0"))
    path = Played(env.unwrapped.model).positions(np.zeros(9), np.zeros(9), np.array([0, 1]), (0, 1, 20), 40)
    end = path[-1, 1]
    radius = end - RADIUS - MARGIN - 0.003
    env.balls = np.array([[-radius - 0.25 - 1.7 * 2.0, 0.0, 7.0]])  # its height does not count
    ball = sw.constraints.Discs("balls", radius, velocity_attribute="rolling")
    wall = sw.constraints.Plane([0.0, end + RADIUS + MARGIN + 0.003], [0.0, -1.0])
    raw, plant, clearance = bound([ball, wall], env=env)
    anew(raw, plant, clearance, np.zeros(9), np.zeros(9))
    up = np.array([0.0, 1.0, 0.0])
    forgotten = []
    for k in range(21):
        kept = clearance.memory
        clearance.start()  # without the memory of what was begun there are ways of 8 and of 20 holds alone
        forgotten.append(clearance.admits(up))
        clearance.memory, clearance.seen = kept, None
        assert clearance.admits(up), k
        clearance.executed(up)
        env.step(up)
        plant.observe()
    assert clearance.admits(clearance.backup()) and not clearance.admits(up) and sum(forgotten) < 8


def test_of_the_proposals_the_nearest_comes_first_and_one_is_admitted():
    raw, plant, clearance = bound([TRUE_CARS, PILLARS])
    tried, most = 0, 0
    for qpos, qvel, control in random_states(300, seed=1):
        anew(raw, plant, clearance, qpos, qvel)
        if clearance.value().min() < MARGIN or clearance.admits(control):
            continue
        found = clearance.candidates(control)
        for candidate in found:
            assert candidate[2] == control[2]
            assert (np.abs(candidate[:2]) <= np.maximum(1.0, np.abs(control[:2])) + 1e-12).all()
        away = [np.linalg.norm(s - control) for s in found]
        assert away == sorted(away)
        if found:
            tried += 1
            assert any(clearance.admits(candidate) for candidate in found)
            assert clearance.admits(clearance.backup())
            most = max(most, len(found))
    assert tried > 8 and most > 5  # not only braking and full drive along an axis


def test_under_a_delay_all_are_where_they_will_be():
    for delay, actual in ((0.04, 0.04), (0.1, 0.1), (0.015, 0.02)):  # in whole physics steps
        raw, plant, clearance = bound([TRUE_CARS], delay_s=delay)
        qpos = np.array([0.0, -2.0, 0, -3, -1, 2, 3, 1, -2])
        qvel = np.array([1.0, 0.5, 0, 1.2, 1.0, 0.8, -1, -1.3, -1])
        anew(raw, plant, clearance, qpos, qvel)
        played = Played(raw.model)
        played.data.qpos[:], played.data.qvel[:] = qpos, qvel
        for _ in range(round(actual / 0.01)):
            mujoco.mj_step(played.model, played.data)
        cars = foretold(qpos, qvel, np.array([actual]))[0]
        expected = np.linalg.norm(cars - played.data.qpos[:2], axis=1) - CAR - RADIUS
        np.testing.assert_allclose(clearance.value(), expected, atol=1e-9)


def test_the_backup_stands_still_where_that_is_safe_and_goes_where_it_is_not():
    raw, plant, clearance = bound([TRUE_CARS])
    away = [-10.0, -15.0, -20.0, 10.0, 15.0, 20.0]
    speeds = [0.0] * 3 + [1.0] * 3 + [-1.0] * 3
    anew(raw, plant, clearance, [0.0, -2.9, 0.0, *away], speeds)
    assert (clearance.backup() == 0.0).all()
    moving = [0.5, 0.3, *speeds[2:]]  # braking: against the motion, just to rest
    anew(raw, plant, clearance, [0.0, -2.9, 0.0, *away], moving)
    backup = clearance.backup()
    assert (backup[:2] < 0.0).all() and backup[2] == 0.0
    kinds = set()
    for x in np.arange(-1.5, -0.7, 0.05):  # in the lane, a car that comes nearer and nearer
        anew(raw, plant, clearance, [0.0, -0.8, 0.0, x, *away[1:]], speeds)
        stays = clearance.slack(np.zeros(3)) >= 0.0
        backup = clearance.backup()
        assert np.abs(backup[:2]).max() == (0.0 if stays else 1.0)
        assert clearance.slack(backup) >= clearance.slack(np.zeros(3))
        kinds.add(stays)
    assert kinds == {True, False}


@pytest.mark.parametrize(("speed", "admitted"), [(-1.2, False), (0.7, True)])
def test_a_deep_violation_must_shrink_exponentially_and_need_not_be_gone_at_once(speed, admitted):
    """15 cm inside a wall, coming or leaving: what full drive away leaves at every second hold, on the env itself."""
    raw, plant, limit = bound([sw.constraints.Plane([0.0, 0.0], [0.0, -1.0])])
    anew(raw, plant, limit, [0.0, 0.15 - RADIUS, *[9.0] * 7], [0.0, -speed, *[0.0] * 7])
    assert limit.value() == pytest.approx([-0.15])
    away = np.array([0.0, -1.0, 0.0])
    slack = limit.slack(away)
    assert limit.admits(away) == admitted
    left = []
    for k in range(1, 22):
        raw.step(away)
        wanted = MARGIN - (0.15 + MARGIN) * np.exp(-k * HOLD / 0.4)
        left.append(-raw.agent_position[1] - RADIUS - wanted)
    assert slack == pytest.approx(min(left[::2]), abs=1e-7)
