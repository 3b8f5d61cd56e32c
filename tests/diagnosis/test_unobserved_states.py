"""Unobserved states: against python-control's observability matrix, closed-form slopes, and envs that hide a part."""

import control
import gymnasium as gym
import mujoco
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.diagnosis import diagnose
from safe_wrappers.diagnosis.linear_model import Linearised, observation_reader
from safe_wrappers.diagnosis.recording import record
from safe_wrappers.diagnosis.symptom import NotMeasuredError
from safe_wrappers.diagnosis.symptoms import unobserved_states
from safe_wrappers.diagnosis.symptoms.unobserved_states import _wander, unseen

pytest.importorskip("gymnasium_robotics")
from planted import HIDDEN, Bench, partly, still, waving

pytestmark = pytest.mark.filterwarnings("ignore")
ROLLING = """
<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody>
  <body name="cart"><joint name="cart" type="slide" axis="1 0 0" damping="2"/><geom size=".1" mass="2"/></body>
  <body name="ball" pos="0 2 0"><freejoint name="ball"/><geom size=".1" mass="1" contype="0" conaffinity="0"/></body>
</worldbody><actuator><motor joint="cart" ctrlrange="-2 2" ctrllimited="true"/></actuator></mujoco>
"""


def none(data):
    return np.zeros(0)


def measured(env, steps=120, policy=None):
    return unobserved_states.measure(env, record(env, policy or waving(env, 0.5, 50.0), steps, 0))


def evidence(found):
    return {each.name: each.value for each in found.evidence}


@pytest.mark.parametrize("seed", range(12))
def test_what_is_never_shown_is_the_kernel_of_python_controls_matrix(seed):
    rng = np.random.default_rng(seed)
    n, hidden = 6, seed % 4
    a = np.zeros((n, n))
    a[: n - hidden, : n - hidden] = np.linalg.qr(rng.normal(size=(n - hidden, n - hidden)))[0]
    a[n - hidden :, n - hidden :] = np.diag(rng.uniform(0.5, 1.0, hidden))  # the last ones move nothing else
    a[n - hidden :, : n - hidden] = rng.normal(size=(hidden, n - hidden))
    c = np.hstack([rng.normal(size=(2, n - hidden)), np.zeros((2, hidden))])
    turned = np.linalg.qr(rng.normal(size=(n, n)))[0]
    a, c = turned @ a @ turned.T, c @ turned.T
    basis = unseen(a, c)
    matrix = control.obsv(a, c)
    assert basis.shape[1] == n - np.linalg.matrix_rank(matrix, tol=1e-6) == hidden
    assert np.abs(matrix @ basis).max(initial=0.0) < 1e-6


def test_slopes_are_those_of_the_closed_form():
    env = Bench(ROLLING, [0.0, 0.0, 2.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    recording = record(env, waving(env, 0.5, 50.0), 60, 0)
    recording.qvel[:, 1] = np.linspace(0.0, 1.0, 60)  # as if the ball rolled along x
    linear = Linearised(env, recording, none)
    assert "ball turn z" not in linear.names and {"cart", "speed of cart", "speed of ball x"} <= set(
        linear.names
    )
    model = linear.at(30, lambda: np.zeros(0))
    at = [linear.names.index(name) for name in ("cart", "speed of cart")]
    found = model.a[np.ix_(at, at)] * linear.spread[at][:, None] / linear.spread[at]
    kept, dt, substeps = 1.0 / (1.0 + 0.01 * 2.0 / 2.0), 0.01, 5  # MuJoCo's Euler is implicit in the damping
    speeds = kept ** np.arange(1, substeps + 1)
    assert found == pytest.approx(np.array([[1.0, dt * speeds.sum()], [0.0, speeds[-1]]]), abs=1e-6)


def test_a_direction_is_counted_if_the_task_counts_it():
    whole = Bench(HIDDEN, [0.0, 1.0])
    assert measured(whole).figure == 0.0
    hidden = measured(partly(Bench(HIDDEN, [0.0, 1.0]), [1, 3]))
    assert hidden.figure == 2.0 and (hidden.steps == 2.0).all() and len(hidden.steps) == 120
    names = [name for name in evidence(hidden) if "not shown" in name]
    assert names == ["not shown, spread: ball", "not shown, spread: speed of ball"]
    one = evidence(measured(partly(Bench(HIDDEN, [0.0, 1.0]), [2, 3])))  # positions alone
    assert one["that one observation does not show, and several do"] == 2.0
    assert not any("not shown" in name for name in one)


def test_what_sways_nothing_is_told_and_not_counted():
    found = measured(gym.make("HalfCheetah-v5"))
    assert found.figure == 0.0 and "not shown, and without effect, spread: rootx" in evidence(found)


def test_the_reward_makes_it_count():
    class FarIsGood(gym.envs.mujoco.half_cheetah_v5.HalfCheetahEnv):
        def step(self, action):
            observation, reward, *rest = super().step(action)
            return observation, reward + 5.0 * float(self.data.qpos[0]), *rest

    found = measured(FarIsGood())
    assert found.figure == 1.0 and "not shown, spread: rootx" in evidence(found)


def test_the_cost_makes_it_count():
    class Counted(Bench):
        def step(self, action):
            observation, *rest, _ = super().step(action)
            return observation, *rest, {"cost": max(float(self.data.qpos[1]), 0.0)}

    # A single machine, so that no place counts: a second slide of the same body's.
    slides = HIDDEN.replace('damping="2"/>', 'damping="2"/><joint name="up" type="slide" axis="0 1 0"/>')
    slides = slides[: slides.index('<body name="ball"')] + slides[slides.index("</worldbody>") :]
    for kind, figure in ((Bench, 0.0), (Counted, 2.0)):
        env = partly(kind(slides, [0.0, 0.5]), [1, 3])
        recording = record(env, waving(env, 0.5, 50.0), 60, 0)
        recording.qvel[:, 1] = np.linspace(0.0, 1.0, 60)
        recording.qpos[:, 1] = np.linspace(0.5, 0.7, 60)
        assert unobserved_states.measure(env, recording).figure == figure


def test_the_lines_track_what_is_not_shown_and_a_policy_keeps_its_observation():
    env = partly(Bench(HIDDEN, [0.0, 1.0]), [1, 3])
    shapes, waves = set(), waving(env, 0.2, 200.0)

    def policy(observation):
        shapes.add(observation.shape)
        return waves(observation)

    finding = diagnose(env, policy, steps=450, symptoms=["unobserved_states"]).findings[0]
    assert finding.figure == 2.0 and finding.after == 0.0 and shapes == {(2,)}
    assert "means = {'ball':" in finding.code and "Sensor(camera='eye')" in finding.code
    scope = {"env": env, "sw": sw}
    exec(finding.code, scope)
    recording = record(scope["env"], waves, 450, 0)
    seen = np.array([info["occlusion/visible"][0] for info in recording.infos])
    gone = max(len(run) for run in "".join("01"[int(not each)] for each in seen).split("0"))
    told = evidence(unobserved_states.measure(scope["env"], recording))
    assert told["longest time that a tracked thing is out of sight"] == pytest.approx(gone * env.unwrapped.dt)
    assert told["out of sight, of all tracked things"] == pytest.approx(1.0 - seen.mean())
    expired = [info | {"occlusion/expired": np.array([True])} for info in recording.infos]
    recording.infos[:] = expired
    assert unobserved_states.measure(scope["env"], recording).figure == 2.0
    assert unobserved_states.lines(scope["env"], recording)[0] == ""  # it is tracked already


def test_where_only_an_attacker_leaves_a_sensors_range_the_env_is_not_blamed():
    found = diagnose(gym.make("SafePointGoal0-v0"), steps=700, symptoms=["unobserved_states"]).findings[0]
    assert found.by_driver["attacking"] > 0.0 == found.by_driver["random"] == found.figure


def test_speeds_that_wander_are_recovered():
    rng, dt, memory_s, noise = np.random.default_rng(0), 0.05, 2.0, 0.03
    off = np.zeros((40_000, 1, 2))
    kept = np.exp(-dt / memory_s)
    for k in range(1, len(off)):
        off[k, 0, 0] = kept * off[k - 1, 0, 0] + np.sqrt(noise * dt) * rng.standard_normal()

    class Seen:
        first = np.zeros(len(off), dtype=bool)
        control_dt = dt

    found, memory = _wander(off, Seen())
    assert found == pytest.approx([noise, 0.0], rel=0.05) and memory == pytest.approx(memory_s, rel=0.1)


def test_a_target_that_is_not_shown_is_told():
    env = partly(gym.make("Reacher-v5"), [4, 5, 8, 9])
    finding = diagnose(env, waving(env, 0.05), steps=120, symptoms=["unobserved_states"]).findings[0]
    names = [each.name for each in finding.evidence]
    assert finding.figure == 2.0 and not finding.code and "into the observation" in finding.advice
    assert "not shown, spread: target_x" in names and "not shown, spread: target_y" in names


def test_the_data_are_put_back_and_wrappers_that_only_scale_are_seen_through():
    env = gym.wrappers.NormalizeObservation(gym.make("Swimmer-v5"))
    recording = record(env, waving(env), 40, 0)
    before, seen = env.unwrapped.data.qpos.copy(), env.obs_rms.count
    assert unobserved_states.measure(env, recording).figure == 0.0
    assert np.array_equal(env.unwrapped.data.qpos, before) and env.obs_rms.count == seen


def test_mazes_and_dictionaries_are_read():
    env = gym.make("PointMaze_UMaze-v3")
    env.reset(seed=0)
    shown = env.unwrapped._get_obs(env.unwrapped.point_env._get_obs()[0])
    flat = np.concatenate([np.ravel(each) for each in shown.values()])
    assert np.array_equal(observation_reader(env)(), flat)


def test_what_cannot_be_measured_is_said():
    class Noisy(Bench):
        def _get_obs(self):
            return super()._get_obs() + np.random.default_rng().normal(size=4)

    class Silent(Bench):
        _get_obs = None

        def reset(self, **options):
            self.steps = 0
            return np.zeros(4), {}

        def step(self, action):
            mujoco.mj_step(self.model, self.data, 5)
            return np.zeros(4), 0.0, False, False, {}

    class Pictures(Bench):
        def _get_obs(self):
            return np.zeros((2, 2), np.uint8)

    class Fails(Bench):
        def _get_obs(self):
            if not np.isfinite(self.data.qacc).all() or self.steps > 10:
                raise ValueError("no map")
            return super()._get_obs()

    cases = (
        (gym.make("Pendulum-v1"), "no MuJoCo model"),
        (Noisy(HIDDEN), "two observations of one state"),
        (Silent(HIDDEN), "neither observe"),
        (Pictures(HIDDEN), "change smoothly"),
        (sw.FilterObservation(sw.protect(gym.make("SafePointGoal1-v0"))), "FilterObservation shows another"),
    )
    for env, why in cases:
        with pytest.raises(NotMeasuredError, match=why):
            measured(env, 5, still(env))
    env = Fails(HIDDEN)
    recording = record(env, still(env), 5, 0)
    env.steps = 20
    with pytest.raises(NotMeasuredError, match=r"raised ValueError.*no map"):
        unobserved_states.measure(env, recording)

    class Stops(Bench):
        def step(self, action):
            if self.steps > 20:
                raise RuntimeError("reset me")
            return super().step(action)

    env = partly(Stops(HIDDEN, [0.0, 1.0]), [1, 3])
    recording = record(env, waving(env), 20, 0)
    env.unwrapped.steps, before = 99, env.unwrapped.data.qpos.copy()
    with pytest.raises(NotMeasuredError, match=r"RuntimeError in a state next to.*reset me"):
        unobserved_states.measure(env, recording)
    assert np.array_equal(env.unwrapped.data.qpos, before)
    resting = Bench(ROLLING)
    recording = record(resting, still(resting), 5, 0)
    recording.qpos[:], recording.qvel[:] = recording.qpos[0], 0.0
    with pytest.raises(NotMeasuredError, match="nothing has moved"):
        unobserved_states.measure(resting, recording)
