"""The singularity benchmark in small: its truth is MuJoCo's, watching changes nothing, and it sees what is wrong."""

from unittest import mock

import numpy as np
import pytest

import safe_wrappers as sw
from benchmarks import singularity as benchmark
from benchmarks.arms import ARMS, Truth, watch
from safe_wrappers.constraints.limits.singularity_margin import BoundSingularityMargin


def made(name):
    if name == "Fetch":
        pytest.importorskip("gymnasium_robotics")
    return ARMS[name].make()


@pytest.mark.parametrize("name", ARMS)
def test_watching_an_arm_does_not_change_it(name):
    plain, watched = made(name), made(name)
    truth = Truth(ARMS[name], watched)
    seen = watch(watched, truth)
    plain.reset(seed=0)
    watched.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(5):
        action = rng.uniform(plain.action_space.low, plain.action_space.high).astype(plain.action_space.dtype)
        plain.step(action)
        watched.step(action)
        assert np.array_equal(plain.unwrapped.data.qpos, watched.unwrapped.data.qpos)
        assert np.array_equal(plain.unwrapped.data.qvel, watched.unwrapped.data.qvel)
        rate = np.abs(watched.unwrapped.data.qvel[truth.dofs]).max()
        assert (
            len(seen.w) == len(seen.rate) == sw.CBFActionFilter(plain, [ARMS[name].margin()]).plant.substeps
        )
        assert seen.rate[-1] == rate
        if name != "Fetch":  # there the fingers are put back after the last substep
            assert seen.w[-1] == truth.w(watched.unwrapped.data.qpos)


def test_the_truth_and_the_paths_of_reacher_in_closed_form():
    truth = Truth(ARMS["Reacher"], made("Reacher"))
    rng = np.random.default_rng(0)
    for q in truth.sample(rng, 20):
        assert truth.w(q) == pytest.approx(0.011 * abs(np.sin(q[1])), rel=1e-9)
    for kind, farthest in (("past the base", 0.16), ("full stretch", 0.2115)):
        path, lasts = benchmark.reacher_path(kind, rng)
        places = np.array([path(t) for t in np.linspace(0.0, lasts, 400)])
        assert np.linalg.norm(places, axis=1).max() <= farthest
        speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) / (lasts / 399)
        np.testing.assert_allclose(speeds, benchmark.SPEED["Reacher"], rtol=1e-3)
        joints = benchmark.elbow(places[0], -1.0)
        tip = 0.1 * np.array([np.cos(joints[0]), np.sin(joints[0])])
        tip = tip + 0.11 * np.array([np.cos(joints.sum()), np.sin(joints.sum())])
        np.testing.assert_allclose(tip, places[0], atol=1e-12)


def test_qr_is_as_good_as_svd_and_the_determinant_is_not():
    pytest.importorskip("gymnasium_robotics")
    rows = benchmark.measure(300)
    assert [r["what"] for r in rows[:3]] == list(ARMS) and all(r["count"] == 300 for r in rows)
    assert all(r["qr_error"] < 1e-8 and r["qr_failed"] == 0 for r in rows[:3])
    near = rows[3]
    assert near["qr_error"] < 1e-6 and near["determinant_failed"] + (near["determinant_error"] > 0.1) > 0
    assert len(benchmark.measure_table(rows).splitlines()) == 6


def test_with_the_constraint_a_path_beyond_reach_costs_error_instead_of_joint_rates():
    off, on = (
        benchmark.follow(benchmark.PathJob("Reacher", "full stretch", m, 2)) for m in ("off", "margin")
    )
    assert off["steps"] == on["steps"] and off["below"] > 0 == off["changed"]
    assert on["below"] == on["unflagged"] == 0 < on["changed"]
    assert on["peak"] < off["peak"] and on["error_rms"] > off["error_rms"]
    text = benchmark.path_table([off, on])
    assert "| none |" in text and "| `SingularityMargin` |" in text and "0 of 250 |" in text


def test_a_constraint_that_admits_everything_is_seen():
    job = benchmark.AttackJob("Reacher", "seeking", True, 60)
    good = benchmark.attack(job)
    assert good["unflagged"] == 0 and good["changed"] > 0
    # Bends the arm as it should at first, and then looks away.
    own = BoundSingularityMargin.admits
    blind = mock.patch.object(
        BoundSingularityMargin, "admits", lambda self, u: self.plant.time > 0.5 or own(self, u)
    )
    with blind:
        bad = benchmark.attack(job)
    assert bad["unflagged"] > 0 and bad["least"] < 1.0
    off = benchmark.attack(benchmark.AttackJob("Reacher", "seeking", False, 60))
    assert off["below"] > good["below"] and off["changed"] == 0
    text = benchmark.attack_table([off, good])
    assert "| Reacher | seeking | 60 |" in text
