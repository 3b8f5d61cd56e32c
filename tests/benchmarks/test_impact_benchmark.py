"""The impact benchmark in small: its wall is the spring that it says, and it sees a constraint that is wrong."""

import mujoco
import numpy as np
import pytest

import safe_wrappers as sw
from benchmarks import impact as benchmark
from benchmarks.arm_and_wall import ArmAndWall, normal_force


@pytest.mark.parametrize("payload", [0.0, 1.5])
@pytest.mark.parametrize("qpos", [(0.0, 0.0), (0.5, -1.0), (0.3, 1.4)])
def test_the_wall_is_a_spring_of_its_stiffness_in_every_pose(qpos, payload):
    env = ArmAndWall(25e3, payload)
    env.reset(options={"qpos": qpos})
    tip = env.data.geom("fingertip").xpos[0] + 0.01
    for depth in (0.001, 0.004):
        env.reset(options={"qpos": qpos, "distance": tip - depth})
        assert normal_force(env.data) == pytest.approx(25e3 * depth, rel=5e-3)
        wrench = np.zeros(6)
        mujoco.mj_contactForce(env.model, env.data, 0, wrench)
        assert wrench[0] == normal_force(env.data)
    env.reset(options={"qpos": qpos, "distance": tip + 1e-6})
    assert normal_force(env.data) == 0.0


def test_the_wall_can_stand_in_every_direction():
    env = ArmAndWall(25e3)
    rng = np.random.default_rng(0)
    for _ in range(20):
        options = benchmark.start(rng)
        env.reset(options=options)
        m, d = env.model, env.data
        gap = mujoco.mj_geomDistance(m, d, m.geom("fingertip").id, m.geom("wall").id, 9.0, None)
        along = env.distance - 0.01 - float(d.geom("fingertip").xpos @ env.normal)
        assert gap == pytest.approx(along, abs=1e-9) and 0.005 < gap < 0.15


def test_peaks_follow_the_formula_where_the_physics_step_is_short():
    assert benchmark.oracle() < 1e-9
    fine = benchmark.grid(1e-4)
    assert fine["cases"] == 48 and fine["mean"] < 1e-4 and fine["worst"] < 1e-3
    assert benchmark.grid(2e-3)["worst"] > 10.0 * fine["worst"]


def test_of_an_arm_the_formula_is_nearly_an_upper_bound():
    found = benchmark.unpowered(60)
    assert found["all"]["hits"] == 60 > found["square"]["hits"] > 0
    assert found["all"]["lowest"] < -0.3 and found["all"]["highest"] < 0.03


@pytest.mark.slow
def test_with_the_constraint_nothing_exceeds_the_limit_and_without_most_does():
    off, on = (benchmark.run(benchmark.Job(limited, 0, 20)) for limited in (False, True))
    assert off["exceeded"] >= 8 and off["worst"]["share"] > 3.0
    assert on["exceeded"] == on["reported"] == 0 and on["touched"] >= 5
    assert 0.8 < on["worst"]["share"] <= 1.0
    assert on["steps"] == off["steps"] == 20 * benchmark.STEPS and on["changed"] > 0
    text = benchmark.approach_table([off, on])
    assert "| on | 20 |" in text and "| 0 (0.00%) |" in text and "| off | 20 |" in text


@pytest.mark.slow
def test_a_constraint_that_believes_in_a_softer_wall_is_seen(monkeypatch):
    honest = sw.constraints.ImpactSpeedLimit

    def softer(*args, stiffness, **more):
        return honest(*args, stiffness=stiffness / 4.0, **more)

    monkeypatch.setattr(benchmark.sw.constraints, "ImpactSpeedLimit", softer)
    assert benchmark.run(benchmark.Job(True, 0, 20))["exceeded"] > 0
