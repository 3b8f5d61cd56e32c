"""Envs in processes of their own: the same run as in one process, and no process left behind."""

import functools
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
import uuid
from pathlib import Path

import numpy as np
import pytest
from gymnasium.spaces import Box
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv
from test_learner import one_arm
from test_run import Reports

from safe_wrappers.errors import RunStateError, UnknownNameError
from safe_wrappers.train.run import training as run_module
from safe_wrappers.train.run import vec_envs
from safe_wrappers.train.run.checkpoint import latest_checkpoint
from safe_wrappers.train.run.stack import ProcessVecEnv, make_stack
from safe_wrappers.train.run.training import train_run

WAIT_S = 300.0
"""For three generations of processes to import torch on a busy machine."""
TIMES = ("t", "filter_time_us")


class Everything(BaseCallback):
    """What the algorithm was given."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def _on_step(self):
        self.seen.append({k: self.locals[k] for k in ("new_obs", "rewards", "dones", "infos")})
        return True


def assert_same(one, other, where=""):
    """Values and types, but for what was read from a clock."""
    assert type(one) is type(other), where
    if isinstance(one, dict):
        assert one.keys() == other.keys(), where
        for key in one.keys() - {*TIMES}:
            assert_same(one[key], other[key], f"{where}.{key}")
    elif isinstance(one, list | tuple):
        assert len(one) == len(other), where
        for at, (mine, theirs) in enumerate(zip(one, other, strict=True)):
            assert_same(mine, theirs, f"{where}[{at}]")
    else:
        np.testing.assert_array_equal(one, other, err_msg=where)
        assert np.asarray(one).dtype == np.asarray(other).dtype, where


def trained(fake_experiment, monkeypatch, vec_env, algorithm, *more):
    settings = {
        "PPO": "hyperparameters={n_steps: 32, batch_size: 32, n_epochs: 1, policy_kwargs: {net_arch: [8]}}",
        "SAC": "hyperparameters={learning_starts: 64, batch_size: 8, policy_kwargs: {net_arch: [8]}}",
    }[algorithm]
    learner = "{kind: both, penalty: 0.5}" if algorithm == "SAC" else "{kind: adaption_penalty, penalty: 0.5}"
    experiment = one_arm(
        fake_experiment, learner, settings, f"vec_env={vec_env}", f"name={vec_env}_{algorithm}",
        "total_steps=128", *more, algorithm=algorithm,
    )  # fmt: skip
    (arm,) = experiment.arms
    folder, everything = experiment.run_folder(arm, 0), Everything()
    monkeypatch.setattr(run_module, "InterventionCallback", lambda: everything)
    train_run(arm, 0, folder, Reports().progress)
    model = latest_checkpoint(folder / "checkpoints", pytest.fail).load_model(algorithm, None, "cpu")
    return everything.seen, (folder / "episodes.csv").read_text(), model.policy.state_dict(), arm


def compare(fake_experiment, monkeypatch, algorithm, *more):
    here = trained(fake_experiment, monkeypatch, "dummy", algorithm, *more)
    there = trained(fake_experiment, monkeypatch, "subproc", algorithm, *more)
    assert len(here[0]) == 64
    assert_same(here[0], there[0])
    assert here[1] == there[1]
    for key, weights in here[2].items():
        np.testing.assert_array_equal(weights.numpy(), there[2][key].numpy(), err_msg=key)
    assert here[3].fingerprint() == there[3].fingerprint()


@pytest.mark.parametrize("algorithm", ["PPO", "SAC"])
@pytest.mark.parametrize("normalize", ["{}", "{observation: true, reward: true}"])
def test_the_same_run_bit_for_bit(fake_experiment, monkeypatch, algorithm, normalize):
    # As `spawn`, which a run uses, but without the seconds in which torch is imported.
    monkeypatch.setattr(vec_envs, "ProcessVecEnv", functools.partial(ProcessVecEnv, start_method="fork"))
    compare(fake_experiment, monkeypatch, algorithm, f"normalize={normalize}")
    assert not multiprocessing.active_children()


@pytest.mark.slow
def test_the_same_run_bit_for_bit_as_it_is_started(fake_experiment, monkeypatch):
    compare(fake_experiment, monkeypatch, "PPO")


def test_observations_have_the_type_that_the_space_says(fake_experiment):
    arm = one_arm(fake_experiment, "naive").arms[0]

    def make():
        env = make_stack(arm.env, arm.filter)
        env.unwrapped.observation_space = Box(-np.inf, np.inf, (2,), np.float32)
        return env

    fork = ProcessVecEnv([make] * 2, start_method="fork")
    dummy = DummyVecEnv([make] * 2)
    for envs in (fork, dummy):
        envs.seed(3)
    assert_same(fork.reset(), dummy.reset())
    for _ in range(25):
        assert_same(list(fork.step(np.ones((2, 2)))), list(dummy.step(np.ones((2, 2)))))
    fork.close()


def test_a_dead_env_is_said_and_closed(fake_experiment):
    arm = one_arm(fake_experiment, "naive").arms[0]
    make = functools.partial(make_stack, arm.env, arm.filter)
    envs = ProcessVecEnv([make] * 2, start_method="fork")
    envs.reset()
    # The first: a forked second one would hold the other end of the first one's pipe, a spawned one holds none.
    os.kill(envs.processes[0].pid, signal.SIGKILL)
    envs.processes[0].join()
    with pytest.raises(RunStateError, match=r"The process of an env has ended: .*vec_env: dummy"):
        envs.step(np.zeros((2, 2)))
    envs.close()
    assert not multiprocessing.active_children()


def test_an_unknown_kind_is_refused_with_the_nearest(fake_experiment):
    with pytest.raises(UnknownNameError, match=r"vec_env: unknown name 'subprocess'. Did you mean 'subproc'"):
        one_arm(fake_experiment, "naive", "vec_env=subprocess")


def marked(mark):
    """Processes that have this text in their environment."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if mark.encode() in (folder / "environ").read_bytes():
                found.append(int(folder.name))
        except OSError:
            continue
    return found


def until(condition):
    end = time.monotonic() + WAIT_S
    while not condition():
        if time.monotonic() > end:
            pytest.fail("waited in vain")
        time.sleep(0.1)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="counts processes as Linux lists them")
@pytest.mark.parametrize(
    "by", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT, None], ids=lambda by: by.name if by else "itself"
)
def test_no_process_outlives_the_command(tmp_path, by):
    """Command -> run -> env, three generations: all gone when the first is, however it ended."""
    config = tmp_path / "three.yaml"
    steps = 512 if by is None else 10_000_000
    config.write_text(
        f"{{name: three, env: fake_task:FakeGoal-v0, algorithm: PPO, total_steps: {steps}, n_envs: 2, seeds: [0],"
        " vec_env: subproc, hyperparameters: {n_steps: 64, n_epochs: 1, policy_kwargs: {net_arch: [8]}},"
        f" arms: {{a: {{filter: none}}}}, output: {tmp_path}}}"
    )
    mark = f"MARK={uuid.uuid4()}"
    key, _, value = mark.partition("=")
    command = [sys.executable, "-m", "safe_wrappers.train.cli", "train", str(config)]
    here = Path(__file__).parent  # where the fake task lies
    process = subprocess.Popen(command, env={**os.environ, key: value}, stdout=subprocess.DEVNULL, cwd=here)
    try:
        if by is not None:
            rows = tmp_path / "three" / "a" / "seed_0" / "episodes.csv"
            until(lambda: rows.exists() and len(rows.read_text().splitlines()) > 5)
            assert len(marked(mark)) >= 4
            process.send_signal(by)
        process.wait(timeout=WAIT_S)
    finally:
        process.kill()
        process.wait()
    until(lambda: not marked(mark))
    if by is None:
        finished = tmp_path / "three" / "a" / "seed_0" / "finished.json"
        assert json.loads(finished.read_text())["timesteps"] == steps
