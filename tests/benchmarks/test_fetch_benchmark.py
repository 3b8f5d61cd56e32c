"""The Fetch benchmark: its judge against positions placed by hand, its drivers, its table."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import safe_wrappers as sw

gym.register_envs(pytest.importorskip("gymnasium_robotics"))
from benchmarks import fetch  # noqa: E402 (it needs gymnasium_robotics)
from benchmarks.fetch_drivers import drivers, obstacles  # noqa: E402
from benchmarks.fetch_judge import GRACE, FetchJudge, ball_of, box_of  # noqa: E402

pytestmark = pytest.mark.filterwarnings("ignore::safe_wrappers.errors.UnsafeStateWarning")


def made(env_id="FetchReach-v4", ball=False):
    env = gym.make(env_id, max_episode_steps=200)
    env.reset(seed=0)
    return env, FetchJudge(env.unwrapped, ball)


def site(raw):
    mujoco.mj_kinematics(raw.model, raw.data)
    return raw.data.site_xpos[raw.model.site("robot0:grip").id].copy()


def step(env, judge, action):
    judge.before()
    env.step(np.asarray(action, np.float32))
    return judge.after(action, {})


@pytest.mark.parametrize("env_id", fetch.ENVS)
def test_the_judge_means_the_box_that_the_filter_keeps(env_id):
    env, judge = made(env_id)
    box, clear = sw.protect(env).constraints
    assert judge.low.tolist() == pytest.approx(box.low) and judge.high.tolist() == pytest.approx(box.high)
    assert box_of(env.unwrapped)[0].tolist() == judge.low.tolist()
    (table,) = clear.keep_out
    assert table.center[2] + table.half_size[2] == pytest.approx(judge.low[2] - 0.02)


def test_being_judged_changes_nothing():
    plain, judged = gym.make("FetchPickAndPlace-v4"), gym.make("FetchPickAndPlace-v4")
    judge = FetchJudge(judged.unwrapped, ball=True)
    rng = np.random.default_rng(0)
    for env in (plain, judged):
        env.reset(seed=4)
    judge.start()
    for _ in range(15):
        action = rng.uniform(-1.0, 1.0, 4).astype(np.float32)
        plain.step(action)
        step(judged, judge, action)
        assert np.array_equal(plain.unwrapped.data.qpos, judged.unwrapped.data.qpos)
        assert np.array_equal(plain.unwrapped.data.xpos, judged.unwrapped.data.xpos)


@pytest.mark.parametrize("axis, way", [(0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0), (2, 1.0)])
def test_beyond_a_side_it_says_by_how_much(axis, way):
    env, judge = made()
    raw = env.unwrapped
    assert judge.start() < 0.0
    action = np.zeros(4)
    action[axis] = way
    missed = -1.0
    while missed <= 0.0:
        missed = step(env, judge, action)
    place = site(raw)[axis]
    assert missed == pytest.approx((place - judge.high[axis]) if way > 0.0 else (judge.low[axis] - place))


def test_what_happens_within_a_step_counts():
    # In and out again within one step: no one who looks at its end sees it.
    env, judge = made()
    raw = env.unwrapped
    judge.start()
    judge.high[2] = site(raw)[2] + 0.05
    for _ in range(2):
        missed = step(env, judge, [0.0, 0.0, 1.0, 0.0])
    assert missed > 0.0
    while missed > -0.01:
        missed = step(env, judge, [0.0, 0.0, -0.5, 0.0])
    peak, ends = -1.0, []
    for action in (0.55, 0.0, 0.0):
        peak = max(peak, step(env, judge, [0.0, 0.0, action, 0.0]))
        ends.append(float(site(raw)[2] - judge.high[2]))
    assert peak > max(ends) + 1e-4


def test_a_finger_on_the_table_is_seen_from_where_contacts_begin():
    env, judge = made()
    raw = env.unwrapped
    assert judge.start() < 0.0
    missed, low = -1.0, 1.0
    while missed <= 0.0:
        missed = step(env, judge, [0.0, 0.0, -0.2, 0.0])
        low = site(raw)[2] - 0.0185 - 0.4  # of the tips of upright fingers
    assert low < 0.0015
    lifted = [step(env, judge, [0.0, 0.0, 0.5, 0.0]) for _ in range(4)]
    assert lifted[-1] <= 0.0


def test_a_start_in_the_table_is_excused_until_it_is_left_and_not_for_long():
    env, judge = made("FetchPush-v4")
    assert judge.start() <= 0.0
    pressed = [step(env, judge, [0.0, 0.0, -1.0, 0.0]) for _ in range(GRACE + 3)]
    assert judge.excused == GRACE
    assert max(pressed[:GRACE]) <= 0.0 < min(pressed[GRACE:])
    env.reset(seed=1)
    assert judge.start() <= 0.0
    lifted = [step(env, judge, [0.0, 0.0, 1.0, 0.0]) for _ in range(4)]
    assert max(lifted) <= 0.0
    again = [step(env, judge, [0.0, 0.0, -1.0, 0.0]) for _ in range(6)]
    assert max(again) > 0.0  # once out, nothing is excused


def test_a_finger_in_the_ball_is_seen():
    env, judge = made(ball=True)
    centre, radius = ball_of(env.unwrapped)
    assert judge.start() < 0.0
    missed = -1.0
    for _ in range(60):
        place = site(env.unwrapped)
        missed = max(missed, step(env, judge, np.append(np.clip((centre - place) / 0.05, -1.0, 1.0), 0.0)))
    assert missed == pytest.approx(radius, abs=1e-3)  # its centre is in a finger
    (ball,) = obstacles(env.unwrapped)
    assert ball.center == centre.tolist() and ball.radius == radius


@pytest.mark.parametrize("name", sorted(drivers(ball=True)))
def test_drivers_are_seeded_and_stay_in_the_action_space(name):
    def first(seed):
        env = gym.make("FetchPush-v4")
        env.reset(seed=0)
        act = drivers(ball=True)[name](env.unwrapped, np.random.default_rng(seed))
        found = []
        for _ in range(6):
            found.append(np.asarray(act(), np.float32))
            env.step(found[-1])
        return np.array(found)

    once = first(1)
    assert once.shape == (6, 4) and env_box(once)
    assert np.array_equal(once, first(1)) and not np.array_equal(once, first(2))


def env_box(actions):
    return bool((np.abs(actions) <= 1.0).all())


def test_a_run_counts_and_its_table_adds_up():
    rows = [
        fetch.run(fetch.Job("FetchReach-v4", "table-seeking", filtered, 50, 30, 0))
        for filtered in (True, False)
    ]
    on, off = rows
    assert on["violations"] == on["unflagged"] == 0 and off["violations"] > 5 and on["intervened"] > 5
    assert off["worst_m"] > 0.0 > on["worst_m"] and on["filter_us"] > 0.0 and off["filter_us"] is None
    lines = fetch.table(rows).splitlines()
    assert [line.count("|") for line in lines] == [15] * len(lines) and len(lines) == 5
    assert lines[-1].startswith("| all | all | 30 | ")
    wanted = {fetch.Job(**{k: row[k] for k in fetch.Job.__dataclass_fields__}) for row in rows}
    assert len(wanted) == 2
