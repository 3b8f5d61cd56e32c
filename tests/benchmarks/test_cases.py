"""The cases of the benchmarks: every recipe has one, its judge means the recipe's limits, its drivers are seeded."""

import numpy as np
import pytest

import safe_wrappers as sw
from benchmarks.cases import HARD, PROTECTED
from benchmarks.judges import Reported, Worst
from safe_wrappers.constraints.joints import scalar_joints
from safe_wrappers.wrappers.recipes import RECIPES

CASES = PROTECTED | HARD
BLIND = ("random", "bang-bang", "pulse")


def make(case):
    if any(word in case.env_id for word in ("Maze", "Fetch", "Hand")):
        pytest.importorskip("gymnasium_robotics")
    return case.make()


def family(env_id):
    plain = env_id.rpartition("-v")[0].partition("_")[0]
    return plain.removeprefix("Safe").removesuffix("Velocity") if plain.endswith("Velocity") else plain


def test_every_recipe_has_a_case():
    assert {family(case.env_id) for case in PROTECTED.values()} == set(RECIPES)


@pytest.mark.parametrize("name", [n for n in CASES if not ("Goal" in n or "Fetch" in n)])
def test_the_judge_means_the_limit_that_the_filter_keeps(name):
    case = CASES[name]
    env = case.protect(make(case))
    env.reset(seed=0)
    raw = env.unwrapped
    for constraint, bound in zip(env.constraints, env.filter.bound, strict=True):
        judge = case.judge(raw)
        match constraint:
            case sw.constraints.SpeedLimit():
                assert isinstance(judge, Reported)
                info = {"x_velocity": constraint.limit, "y_velocity": 0.0}
                assert judge.after(np.zeros(1), info) == 0.0
                plane = judge.after(np.zeros(1), {"x_velocity": 0.0, "y_velocity": constraint.limit})
                assert (plane == 0.0) == (constraint.direction == "xy")
            case sw.constraints.JointSpeedLimit():
                raw.data.qvel[:] = 0.0
                dofs = raw.model.jnt_dofadr[scalar_joints(env.plant, constraint.joints)]
                for dof in dofs:  # each alone, so that the judge means every joint that the constraint means
                    raw.data.qvel[dof] = -constraint.limit
                    assert judge.start() == pytest.approx(0.0, abs=1e-12)
                    raw.data.qvel[dof] = 0.0
            case sw.constraints.Clearance():
                for plane in constraint.obstacles:
                    (axis,) = np.flatnonzero(plane.normal)
                    raw.data.qpos[axis] = plane.point[axis] + constraint.radius * plane.normal[axis]
                    assert judge.start() == pytest.approx(0.0, abs=1e-12)
                assert len(constraint.obstacles) == (1 if "Teleop" in name else 2)
            case sw.constraints.JointPositionLimit():
                for end in (constraint.lower, constraint.upper):
                    raw.data.qpos[0] = end
                    assert judge.start() == pytest.approx(0.0, abs=1e-12)
            case sw.constraints.Workspace():
                # Somewhere along random poses: what the constraint calls negative, the judge calls missed.
                seen = set()
                rng = np.random.default_rng(0)
                for _ in range(300):
                    if "Maze" in name:
                        raw.data.qpos[:2] = rng.uniform(-6.0, 6.0, 2)
                    else:
                        joints = raw.model.actuator_trnid[:, 0]
                        low, high = raw.model.jnt_range[joints].T
                        unlimited = low == high
                        raw.data.qpos[raw.model.jnt_qposadr[joints]] = rng.uniform(
                            np.where(unlimited, -3.0, low), np.where(unlimited, 3.0, high)
                        )
                    env.plant.observe()
                    bound.observe({})  # it was carried there, it did not move
                    h, missed = float(bound.value().min()), judge.start()
                    if "disc" in name or "Maze" in name:
                        assert (h < 0.0) == (missed > 0.0)
                    else:
                        assert h == pytest.approx(-missed, abs=1e-9)
                    seen.add(h < 0.0)
                assert seen == {True, False}
            case sw.constraints.Traction():
                assert isinstance(judge, Reported)
                slips = {
                    missed: judge.after(np.zeros(1), {"slip_max": missed}) for missed in (0.15, 0.2, 0.5)
                }
                # Looser than the limit: an edge is overshot, and a slip of a third more is no spin-out yet.
                assert slips[constraint.max_slip] < slips[0.2] == 0.0 < slips[0.5]
            case sw.constraints.EscapeClearance():
                touched, clear = ({"cost_substep": cost} for cost in (1.0, 0.0))
                if isinstance(judge, Worst):  # of a step in which no wall was touched
                    judge.before()
                    env.unwrapped.step(np.zeros(2))
                assert judge.after(np.zeros(raw.model.nu), touched) > 0.0
                assert judge.after(np.zeros(raw.model.nu), clear) < 0.0
            case sw.constraints.WallClearance():
                pass  # both read the walls from the model; tests/benchmarks/test_judges.py places the ball
            case _:
                raise AssertionError(f"no check for {constraint}")


@pytest.mark.parametrize("name", CASES)
def test_drivers_are_deterministic_by_seed_and_inside_the_box(name):
    case = CASES[name]

    def actions(driver, seed):
        env.reset(seed=3)
        act = case.drivers[driver](env.unwrapped, np.random.default_rng(seed))
        found = []
        for _ in range(8):
            found.append(np.array(act(), dtype=env.action_space.dtype))
            env.step(found[-1])
        return np.array(found)

    env = make(case)
    for driver in case.drivers:
        first = actions(driver, 5)
        assert np.isfinite(first).all()
        assert (first >= env.action_space.low).all() and (first <= env.action_space.high).all()
        assert np.array_equal(first, actions(driver, 5)), driver
        if driver in BLIND:
            assert any(not np.array_equal(first, actions(driver, seed)) for seed in (6, 7, 8)), driver
