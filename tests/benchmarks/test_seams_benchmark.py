"""The seam table: its policy's spline, its measures against scripted chunks and a scripted arm, and one tiny run."""

import dataclasses
import json
import sys

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw

pytest.importorskip("stable_baselines3")  # the policies are SB3's

from benchmarks import chunk_policy, seam_bounds, seams
from benchmarks.chunk_policy import TASKS, basis
from benchmarks.flexible_joint import smoothstep_energy, step_energies
from benchmarks.seam_bounds import Bounds, bounds_of
from benchmarks.seams import Job, Recorder, alone, episode, faded_in, jobs, table

FLEX, REACHER = TASKS[:2]
TINY = tuple(dataclasses.replace(task, steps=1, rollout=64) for task in TASKS[:2])  # one rollout
LONG_AGO = 10**6


@pytest.mark.parametrize("knots", [4, 5, 8])
def test_the_spline_gives_back_lines_and_meets_its_ends(knots):
    inner = np.linspace(0.0, 1.0, knots - 2)
    t = np.concatenate([[0.0] * 3, inner, [1.0] * 3])
    greville = np.array([t[k + 1 : k + 4].mean() for k in range(knots)])  # where a line's knots lie
    made = basis(24, knots)
    np.testing.assert_allclose(made @ greville, np.linspace(0.0, 1.0, 24), atol=1e-12)
    np.testing.assert_allclose(made.sum(axis=1), 1.0)
    np.testing.assert_allclose(made[[0, -1]], np.eye(knots)[[0, -1]], atol=1e-12)


def test_knots_span_each_controls_own_range():
    env = chunk_policy.Knots(sw.ChunkHandover(gym.make("FlexJointReach-v0"), 24, 8, blend="replace"), 5)
    np.testing.assert_allclose(env.action(np.ones((5, 2)))[[0, 11, -1]], [[3.0, 1.0]] * 3, rtol=1e-6)
    np.testing.assert_allclose(env.action(-np.ones((5, 2)))[7], [-3.0, -1.0], rtol=1e-6)


class Shaken(gym.Env):
    """Its vibration at control step t is t, its error 1 m; ten chunks of four control steps."""

    dt = 0.1

    def __init__(self, steps=40):
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = gym.spaces.Box(-1.0, 1.0, (1,))
        self.data = type("Data", (), {"qpos": np.zeros(1), "qvel": np.zeros(1)})()
        self.steps, self.t = steps, 0

    def reset(self, *, seed=None, options=None):
        self.t = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.t += 1
        info = {"vibration_energy": float(self.t - 1), "tracking_error": 1.0}
        return np.zeros(1, np.float32), 1.0, False, self.t == self.steps, info


def alternating():
    """Chunks of 1 and -1 in turn, for one control; the other stays at zero."""
    count = [0]

    def act(observation):
        count[0] += 1
        return np.tile([1.0 if count[0] % 2 else -1.0, 0.0], (12, 1))

    return act


def run_scripted(delay, blend, bounds, **given):
    recorder = Recorder(Shaken())
    env = sw.ChunkHandover(recorder, 12, 4, delay, blend=blend, fallback="zero", **given)
    job = Job("Shaken", "Shaken", "scripted", "-", delay, 2, 0)  # no arm to execute its chunks on alone
    return episode(env, recorder, alternating(), job, bounds, seed=0), recorder


@pytest.mark.parametrize("delay", [0, 2, 4])
def test_what_is_measured_at_scripted_seams(delay):
    found, recorder = run_scripted(delay, "replace", Bounds([5.0, 5.0], 0.1, ""))
    seams_at = np.arange(4, 40, 4) + delay  # the first chunk takes over from nothing
    seams_at = seams_at[seams_at < 40]
    changes = np.flatnonzero(np.abs(np.diff([c[0] for c in recorder.commands])) > 1.5) + 1
    assert changes.tolist() == seams_at.tolist()
    assert len(found.rates) == len(found.energies) == len(found.differences) == len(seams_at)
    ends = [*seams_at[1:], 40]
    assert found.energies.tolist() == [end - 1.0 for end in ends]
    np.testing.assert_allclose(found.rates, 2.0 / 0.1 / 5.0)
    np.testing.assert_allclose(found.differences[-1], [2.0, 2.0, 4.0])
    assert found.total == 40.0
    assert found.cut == 0


@pytest.mark.filterwarnings("ignore:a command was held back")
def test_a_blend_that_keeps_the_limit_and_is_cut_short():
    found, recorder = run_scripted(
        0, "quintic", Bounds([5.0, 5.0], 0.5, ""), blend_time=0.5, rate_limit=[5.0, 5.0]
    )
    assert (found.rates <= 1.0).all()
    assert (found.rates > 0.5).any()
    worst = np.abs(np.diff(np.array(recorder.commands), axis=0)).max() / 0.1 / 5.0
    assert found.rates.max() == pytest.approx(worst)
    assert found.cut == len(found.rates)  # half a second each, every 0.4 s


@pytest.mark.parametrize("delay", [0, 2, 5])
def test_every_method_fades_in_from_nothing_and_leaves_the_rest_alone(delay):
    recorder = Recorder(gym.make("FlexJointReach-v0"))
    env = sw.ChunkHandover(recorder, 24, 8, delay, blend="replace")
    job, bounds = (
        Job("FlexJointReach-v0", FLEX.name, "replace", "-", delay, 2, 0),
        bounds_of(recorder, FLEX.horizon, 1.0),
    )
    episode(env, recorder, lambda observation: np.ones((24, 2)), job, bounds, seed=0)
    sent = np.array(recorder.commands)[delay:, 0]
    assert (np.diff(sent[:13]) > 0.0).all()
    assert np.diff(sent, prepend=0.0).max() < 1.875 / 12.0
    assert (sent[12:] == 1.0).all()
    chunk = np.random.default_rng(0).normal(size=(24, 2)).astype(np.float32)
    assert (faded_in(chunk, LONG_AGO, 12) == chunk).all()


def test_the_arms_bounds_keep_what_they_say():
    env = gym.make("FlexJointReach-v0")
    bounds = bounds_of(env, FLEX.horizon, 1.0)
    arm = env.unwrapped.arm
    angles = np.zeros((50, 2))
    angles[:, 1] = np.linspace(0.0, np.pi, 50)
    constants = arm.stiffness, arm.rotor_inertia, arm.link_inertia(angles)
    for torque in ([1.0, 0.0], [0.0, 1.0], [3.0, 1.0], [3.0, -1.0]):
        stepped = step_energies(torque, *constants).sum(axis=-1)
        left = smoothstep_energy(torque, bounds.blend_time, *constants) / stepped
        assert left.max() <= 0.1
    assert left.max() > 0.01
    # A ramp at the limit, on the arm itself: the most it stores at any moment of it and after.
    raw = env.unwrapped
    for signs in ([1.0, 1.0], [1.0, -1.0]):
        worst = 0.0
        for elbow in (0.1, 1.5, 3.0):
            env.reset(seed=0)
            raw.set_state(np.array([0.0, 0.0, elbow, 0.0]), np.zeros(4))
            for k in range(12):
                torque = np.array(signs) * bounds.rate_limit * min(k + 1, 6) * 0.01
                energy = raw.step(torque)[4]["vibration_energy"]
                worst = max(worst, energy if k >= 6 else 0.0)
        assert worst < 1.1 * seam_bounds.RAMP_ENERGY


def test_alone_a_held_torque_shakes_nothing_and_a_step_does_what_its_energy_says():
    env = gym.make("FlexJointReach-v0").unwrapped
    env.reset(seed=0)
    state = np.array([0.3, 0.02, 1.2, -0.03]), np.array([0.5, 3.0, -0.4, 2.0])  # ringing as it was
    fast = state[0], np.array([4.0, 3.0, -3.0, 2.0])
    assert alone(env, *fast, np.array([[1.0, 0.3]])) < 1e-7  # 3e-4 J without the links' bias or the friction
    held = np.tile([1.0, 0.3], (6, 1))
    step = np.concatenate([held[:1], np.tile([-0.5, 0.3], (5, 1))])
    arm = env.arm
    machine = arm.stiffness, arm.rotor_inertia, arm.link_inertia(np.array([0.3, 1.2]))
    injected = step_energies([1.5, 0.0], *machine).sum()
    assert alone(env, *state, held) < 0.02 * injected
    assert alone(env, *state, step) == pytest.approx(injected, rel=0.15)


def test_reachers_bounds_come_from_the_action_and_the_time_between_seams():
    bounds = bounds_of(gym.make("Reacher-v5"), REACHER.horizon, 1.0)
    assert bounds.rate_limit == [2.0, 2.0]
    assert bounds.blend_time == pytest.approx(0.1)


@pytest.mark.slow
def test_a_tiny_run_trains_once_and_writes_every_row(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(seams, "TASKS", TINY)
    monkeypatch.setattr(seams, "DELAYS", (0, 5))
    arguments = ["seams", "--episodes", "2", "--runs", str(tmp_path / "runs"), "--results", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", arguments)
    trained = []
    real = chunk_policy.train

    def counted(task):
        trained.append(task.env)
        return real(task)

    monkeypatch.setattr(chunk_policy, "train", counted)
    seams.main()
    rows = json.loads((tmp_path / "seams.json").read_text())
    assert len(rows) == sum(len(jobs(task, 2, 0)) for task in TINY) == 50
    for row in rows:
        with_rate = row["bounds"] in ("rate", "rate + time")
        assert row["within"] == row["seams"] or not with_rate
        assert row["seams"] == 2 * (
            24 if row["env"] == "FlexJointReach-v0" else 9 if row["delay"] == 0 else 8
        )
        assert (row["energy_peak_J"] is None) == (row["env"] == "Reacher-v5")
        assert (row["alone_peak_J"] is None) == (row["energy_peak_J"] is None or row["blend"] != "replace")
        assert row["tracking_error_mean_m"] > 0.0 > row["return_mean"]
    printed = capsys.readouterr().out
    assert (tmp_path / "seams.md").read_text() in printed
    assert printed.count("\n| ") == 50 + 2

    assert trained == ["FlexJointReach-v0", "Reacher-v5"]
    before = (tmp_path / "seams.json").read_text()
    seams.main()
    assert len(trained) == 2
    assert (tmp_path / "seams.json").read_text() == before  # the same policy, the same episodes
    assert table(rows) == (tmp_path / "seams.md").read_text().rstrip("\n")

    monkeypatch.setattr(sys, "argv", [*arguments, "--envs", "Flex"])
    seams.main()  # the other task's rows stay, these are made anew
    again = json.loads((tmp_path / "seams.json").read_text())
    assert sorted(again, key=str) == sorted(rows, key=str) and again != rows

    monkeypatch.setattr(sys, "argv", [*arguments, "--bounds", "flexible"])
    seams.main()  # only six rows are made anew, and stand in their places in the table
    partly = json.loads((tmp_path / "seams.json").read_text())
    assert sorted(partly, key=str) == sorted(rows, key=str)
    assert [row["bounds"] for row in partly[-6:]] == ["flexible"] * 6
    assert table(again) == (tmp_path / "seams.md").read_text().rstrip("\n")


@pytest.mark.slow
def test_a_bounded_policy_is_trained_through_its_bounds(monkeypatch):
    given = []
    real = sw.ChunkHandover

    def seen(env, *sizes, **options):
        given.append(options)
        return real(env, *sizes, **options)

    monkeypatch.setattr(sw, "ChunkHandover", seen)
    for task in (TINY[0], dataclasses.replace(TINY[0], bounded=True)):
        chunk_policy.train(task)
    bounds = bounds_of(gym.make("FlexJointReach-v0"), FLEX.horizon, 1.0)
    assert {"rate_limit": bounds.rate_limit, "blend_time": bounds.blend_time} in given
    assert {"blend": "replace"} in given and len(given) == 8


def test_names_tell_tasks_apart():
    assert len({task.name for task in TASKS}) == len(TASKS)


@pytest.mark.parametrize("wrong", [["--episodes", "1"], ["--envs", "Walker"]])
def test_what_cannot_be_run_is_refused(wrong, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["seams", *wrong])
    with pytest.raises(SystemExit):
        seams.main()
    assert "at least 2" in (said := capsys.readouterr().err) or "the envs are" in said
