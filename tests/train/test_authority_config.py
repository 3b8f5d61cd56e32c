"""Faults and leases in configs: what is refused, and what stack comes of them."""

import csv

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError, UnknownNameError
from safe_wrappers.train.config import EnvConfig, FilterConfig, parse_experiment
from safe_wrappers.train.evaluation.summary import summarize
from safe_wrappers.train.run.stack import make_stack
from safe_wrappers.wrappers.faults import DroppedRefreshes, Outages

OUTAGES = {"mean_between_s": 0.2, "mean_length_s": 0.2}
LEASE = {"budget": {"closing_speed": 3.0}, "min_lease_s": 0.02}


def parsed(tmp_path="runs", env="SafePointGoal1-v0", **arms):
    common = {"name": "x", "algorithm": "PPO", "total_steps": 10, "seeds": [0], "output": str(tmp_path)}
    return parse_experiment({**common, "env": env, "arms": arms})


def test_they_are_read_and_change_the_runs_fingerprint_only_where_they_are():
    env = {"id": "SafePointGoal1-v0", "faults": {"Outages": OUTAGES}}
    (plain,) = parsed(a={"filter": "protect"}).arms
    (leased,) = parsed(env=env, a={"filter": {"protect": {"margin": 0.01}, "lease": LEASE}}).arms
    assert leased.env.faults == {"Outages": OUTAGES}
    assert (leased.filter.kind, leased.filter.protect, leased.filter.lease) == (
        "protect",
        {"margin": 0.01},
        LEASE,
    )
    assert "faults" not in plain.fingerprint()["env"] and "lease" not in plain.fingerprint()["filter"]
    assert leased.fingerprint()["env"]["faults"] == {"Outages": OUTAGES}
    assert leased.fingerprint()["filter"]["lease"] == LEASE
    (built,) = parsed(a={"filter": {"factory": "some.module:make", "lease": {}}}).arms
    assert (built.filter.kind, built.filter.lease) == ("factory", {})


@pytest.mark.parametrize(
    ("env", "filter_", "error", "words"),
    [
        ({"id": "Reacher-v5", "faults": {"Outage": {}}}, "none", UnknownNameError, "Did you mean 'Outages'"),
        (
            {"id": "Reacher-v5", "faults": {"Outages": {"mean_betwen_s": 1}}},
            "none",
            UnknownNameError,
            "Did you mean 'mean_between_s'",
        ),
        ({"id": "Reacher-v5", "faults": ["Outages"]}, "none", ConfigurationError, "env.faults"),
        (
            "Reacher-v5",
            {"protect": {}, "lease": {"budget": {"closing": 1}}},
            UnknownNameError,
            "closing_speed",
        ),
        ("Reacher-v5", {"protect": {}, "lease": {"budget": 1.0}}, ConfigurationError, "lease.budget"),
        ("Reacher-v5", {"protect": {}, "lease": {"plant": 1}}, UnknownNameError, "unknown name 'plant'"),
        ("Reacher-v5", {"protect": {}, "lease": {"closing_speed": 3.0}}, UnknownNameError, "closing_speed"),
        ("Reacher-v5", {"lease": LEASE}, ConfigurationError, "beside it"),
    ],
)
def test_what_cannot_be_is_refused_by_name(env, filter_, error, words):
    with pytest.raises(error, match=words):
        parsed(env=env, a={"filter": filter_})


def test_the_stack_has_every_layer_in_its_place():
    faults = {"Outages": OUTAGES, "DroppedRefreshes": {"share": 0.1}}
    stack = make_stack(EnvConfig("SafePointGoal1-v0", {}, faults), FilterConfig(protect={}, lease=LEASE))
    kinds = []
    inner = stack.env
    while isinstance(inner, gym.Wrapper):
        kinds.append(type(inner))
        inner = inner.env
    assert kinds[:5] == [
        DroppedRefreshes,
        Outages,
        sw.RecordInterventions,
        sw.LeaseExpiry,
        sw.CBFActionFilter,
    ]
    stack.reset(seed=0)
    infos = [stack.step(np.array([0.3, 0.1], np.float32))[4] for _ in range(200)]
    assert any(i["fault/active"] for i in infos) and any(i["lease/remaining_s"] > 0.02 for i in infos)
    assert not any(i["cost"] for i in infos)


def test_the_leases_room_is_the_filters_unless_it_is_given():
    two = FilterConfig(protect={}, lease=LEASE)
    with pytest.raises(ConfigurationError, match="2 constraints; say which one"):
        make_stack(EnvConfig("Pusher-v5"), two)
    budget = {"clearance": {"kind": "JointSpeedLimit", "limit": 6.0}, "closing_speed": 100.0}
    assert make_stack(EnvConfig("Pusher-v5"), FilterConfig(protect={}, lease={"budget": budget}))


def test_arguments_that_are_missing_are_named():
    with pytest.raises(ConfigurationError, match=r"env.faults.Outages.*mean_between_s"):
        make_stack(EnvConfig("Reacher-v5", {}, {"Outages": {}}), FilterConfig())


def test_lease_rows_are_summed_up_where_there_is_a_lease_and_left_out_elsewhere(tmp_path):
    experiment = parsed(
        tmp_path,
        bare={"filter": "none"},
        alone={"filter": "protect"},
        leased={"filter": {"protect": {}, "lease": LEASE}},
    )
    for arm in experiment.arms:
        folder = experiment.run_folder(arm, 0)
        (folder / "evaluation").mkdir(parents=True)
        for file in ("episodes.csv", "evaluation/filter_off.csv", "evaluation/filter_on.csv"):
            with (folder / file).open("w", newline="") as out:
                writer = csv.DictWriter(out, ["length", "return", "lease_braking", "lease_expired"])
                writer.writeheader()
                writer.writerows([{"length": 5, "return": 1.0, "lease_braking": 3, "lease_expired": 1}] * 2)
    table = summarize(experiment).table
    assert table["leased"]["training"]["lease_braking"].iqm == 6.0
    assert table["leased"]["filter_on"]["lease_expired"].iqm == 2.0
    for arm, condition in (
        ("bare", "training"),
        ("bare", "filter_on"),  # the first filtered arm's filter, which has no lease
        ("alone", "filter_on"),
        ("leased", "filter_off"),
    ):
        assert "lease_braking" not in table[arm][condition], (arm, condition)
        assert table[arm][condition]["return"].iqm == 1.0
