"""The teleoperation benchmark in small: its judges on made-up episodes, and short runs that differ as they should."""

import math

import numpy as np
import pytest

from benchmarks import teleop as benchmark
from benchmarks.teleop import Job, chatter, excess, jobs, run, tables


def test_the_excess_is_that_of_the_worst_pair_of_ticks():
    rng = np.random.default_rng(0)
    for _ in range(20):
        net, flying = np.cumsum(rng.normal(size=30)), rng.uniform(0.0, 2.0, size=30)
        all_net, all_flying = [0.0, *net], [0.0, *flying]
        pairs = [all_net[t] - all_net[later] - all_flying[t] for t in range(31) for later in range(t, 31)]
        assert excess(net, flying) == pytest.approx(max(pairs))
    # 3 J went in, 2 J are in flight and come out, and 1 J more
    assert excess(np.array([3.0, 3.0, 0.0]), np.array([3.0, 2.0, 0.0])) == pytest.approx(1.0)
    assert excess(np.array([3.0, 3.0, 1.0]), np.array([3.0, 2.0, 0.0])) == 0.0


def test_touches_are_counted_from_the_first_and_ripple_after_the_ramp():
    force = np.zeros(4000)
    force[1000:1100] = 5.0
    force[1200:1300] = 9.0
    force[2500:] = np.tile([4.0, 8.0], 750)
    seen = chatter(force, 1e-3)
    assert seen == {"contacts_per_s": pytest.approx(2 / 3), "ripple_n": pytest.approx(2.0), "peak_n": 9.0}
    never = chatter(np.zeros(4000), 1e-3)
    assert never == {"contacts_per_s": None, "ripple_n": None, "peak_n": 0.0}
    late = chatter(np.append(np.zeros(3990), np.ones(10)), 1e-3)
    assert late["contacts_per_s"] is None and late["ripple_n"] is None


def test_a_late_plain_channel_makes_what_its_ledger_says_and_waves_make_nothing():
    plain = run(Job("plain", "steady", 0.1, "careful", False, 0, steps=2500))
    assert plain["made_j"] > 0.5
    assert plain["made_j"] == pytest.approx(plain["created_j"], rel=1e-6)  # judged from outside, the same
    wave = run(Job("wave", "outages", 0.1, "careful", False, 0, steps=2500))
    assert wave["made_j"] < 1e-12
    assert wave["excess_j"] < 1e-12
    assert wave["flying_j"] > 1e-3
    assert wave["made_at_hand_j"] < 0.01
    assert wave["ripple_n"] is None or wave["ripple_n"] < 5.0
    assert wave == run(Job("wave", "outages", 0.1, "careful", False, 0, steps=2500))


@pytest.mark.slow
def test_who_looks_away_breaches_unless_authority_is_revoked():
    off, on = (run(Job("wave", "rough", 0.05, "looks away", revoked, 0)) for revoked in (False, True))
    assert off["breached_steps"] > 0 and off["least_m"] < 0.0 and off["revoked_steps"] == 0
    assert on["breached_steps"] == 0 and on["least_m"] > 0.0 and on["revoked_steps"] > 0


def test_corners_are_held_against_any_force():
    operator = benchmark.operator_of(Job("wave", "steady", 0.0, "corners", True, 3))
    actions = np.array([operator.act(np.full(9, 100.0)) for _ in range(2000)])
    assert set(map(tuple, actions)) == {(a, b) for a in (-1.0, 1.0) for b in (-1.0, 1.0)}
    held = np.diff(np.flatnonzero(np.any(np.diff(actions, axis=0), axis=1)))
    assert held.min() >= 20 and held.max() < 600  # the same corner may be drawn again


def test_tables_have_a_line_for_all_that_was_run():
    rows = []
    for job in jobs(1):
        ran = job.delay_s in (0.0, 0.1)
        known = {"contacts_per_s": 1.5, "ripple_n": None, "peak_n": 12.0, "swept_m": 0.2, "made_j": 1e-12}
        other = {"excess_j": -1.0, "created_j": 0.0, "flying_j": 0.1, "made_at_hand_j": 0.0, "least_m": 1e-3}
        if ran:
            rows.append({**vars(job), **known, **other, "breached_steps": 0, "revoked_steps": job.steps // 2})
    energy, rules, clearance, both = tables(rows).split("\n\n")
    assert len(energy.splitlines()) == 2 + 3 * 2
    assert energy.splitlines()[2] == (
        "| steady | 0 | 0 / 0 / 0 | 1.5 / 1.5 / 1.5 | - / - / - | 12 / 12 / 12 | 20 / 20 / 20 |"
    )
    assert len(rules.splitlines()) == 2 + 2
    assert len(clearance.splitlines()) == 2 + 3 * 3 * 3
    assert clearance.splitlines()[2] == "| careful | steady | plain | 2 | 0 | 0 | 1.00 | 50.0% |"
    assert len(both.splitlines()) == 2 + 2


def test_jobs_are_all_different_and_seeds_come_one_after_the_other():
    listed = jobs(2)
    assert len(set(listed)) == len(listed)
    assert [job.seed for job in listed] == sorted(job.seed for job in listed)
    assert set(jobs(1)) == {job for job in listed if job.seed == 0}
    assert math.isclose(max(benchmark.DELAYS_S), 0.3)
