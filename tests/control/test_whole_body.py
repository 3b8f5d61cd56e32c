"""Whole-body programs: solved by hand, with nothing eliminated, and by solvers that know no cones."""

import dataclasses

import numpy as np
import pytest
import qpsolvers
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import in_cone
from scipy.linalg import block_diag

from safe_wrappers.control import whole_body
from safe_wrappers.control.contact import friction_pyramid
from safe_wrappers.control.projection import Status
from safe_wrappers.control.whole_body import (
    Program,
    WholeBodyProblem,
    attainable_contact_acceleration,
    by_clarabel,
    solve_cone,
    solve_pyramid,
)

UP = np.array([0.0, 0.0, 1.0])
by_both = pytest.mark.parametrize("solve", [solve_pyramid, solve_cone])


# Programs ---------------------------------------------------------------------------------------------------------


def nearest(point, **parts):
    """The program of the closest point."""
    n = len(point)
    none, zero = np.zeros((0, n)), np.zeros(0)
    fields = {"equal": none, "values": zero, "rows": none, "limits": zero, "cones": np.zeros((0, 3, n))}
    return Program(np.ones(n), -np.array(point), **(fields | parts))


ROWS, LIMITS = np.array([[1.0], [-1.0]]), np.array([-1.0, -1.0])


def test_what_has_no_answer_is_said_to_have_none(monkeypatch):
    assert by_clarabel(nearest([0.0], rows=ROWS, limits=LIMITS)) == "infeasible"
    assert by_clarabel(nearest([0.0], equal=ROWS, values=LIMITS)) == "infeasible"
    open_ended = nearest([0.0], rows=ROWS, limits=np.array([-1.0, np.inf]))
    assert by_clarabel(open_ended) == pytest.approx([-1.0])
    limited = whole_body.clarabel.DefaultSettings()
    limited.max_iter = 1
    monkeypatch.setattr(whole_body.clarabel, "DefaultSettings", lambda: limited)
    assert by_clarabel(open_ended) == "failed"  # its solver reached its limit


@pytest.mark.parametrize("part", ["linear", "values", "limits"])
def test_what_is_no_number_is_failed_and_not_infeasible(part):
    fields = {"values": np.ones(1), "equal": ROWS[:1], "limits": np.ones(2), "rows": ROWS}
    program = nearest([0.0], **fields)
    assert by_clarabel(program._replace(**{part: getattr(program, part) * np.nan})) == "failed"


# Random robots ----------------------------------------------------------------------------------------------------


def robot(seed, nv=8, nu=5, k=3, **more):
    """A made-up robot at an instant in which some control in the box has forces in the pyramids."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(nv, nv))
    inertia, actuation = root @ root.T / nv + np.eye(nv), rng.normal(size=(nv, nu)) * 3.0
    jacobians, drift = rng.normal(size=(k, 3, nv)), rng.normal(size=(k, 3))
    normals = rng.normal(size=(k, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    friction = rng.uniform(0.3, 1.2, k)
    sideways = rng.normal(size=(k, 3)) * 0.1
    forces = 5.0 * rng.uniform(0.2, 1.0, k)[:, None] * (normals + friction[:, None] * sideways)
    bias, control = rng.normal(size=nv) * 3.0, rng.uniform(-0.8, 0.8, nu)
    pushed = np.einsum("kiv,ki->v", jacobians, forces)
    acceleration = np.linalg.solve(inertia, actuation @ control + pushed - bias)
    fields = {"contact_acceleration": jacobians @ acceleration + drift, "force_weight": 1e-3} | more
    return WholeBodyProblem(
        inertia, bias, actuation, jacobians, drift, normals, friction, -np.ones(nu), np.ones(nu),
        rng.uniform(-1.5, 1.5, nu), **fields,
    )  # fmt: skip


def in_full(problem, edges=4):
    """The same program in (u, qacc, f), nothing eliminated, by qpsolvers: control and half the weighted squares."""
    nv, nu, k = len(problem.bias), len(problem.nominal), len(problem.normals)
    n, stacked = nu + nv + 3 * k, problem.jacobians.reshape(3 * k, nv)
    squares = np.concatenate([np.ones(nu), np.zeros(nv), np.full(3 * k, problem.force_weight)])
    linear = np.concatenate([-problem.nominal, np.zeros(n - nu)])
    equal = np.zeros((nv + 3 * k, n))
    equal[:nv] = np.hstack([-problem.actuation, problem.inertia, -stacked.T])
    equal[nv:, nu : nu + nv] = stacked
    value = np.concatenate([-problem.bias, (problem.contact_acceleration - problem.drift).ravel()])
    sides = block_diag(*friction_pyramid(problem.normals, problem.friction, edges))
    rows, free = np.hstack([np.zeros((len(sides), nu + nv)), sides]), np.full(n - nu, np.inf)
    box = np.concatenate([problem.lower, -free]), np.concatenate([problem.upper, free])
    tight = dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), 1e-10)
    program = np.diag(squares), linear, rows, np.zeros(len(sides)), equal, value, *box
    x = qpsolvers.solve_qp(*program, solver="clarabel", **tight)
    return x[:nu], 0.5 * (squares @ x**2 + problem.nominal @ problem.nominal) + linear @ x


@pytest.mark.filterwarnings("ignore::UserWarning")
@settings(max_examples=25)
@given(seed=st.integers(0, 10_000), k=st.integers(0, 5))
def test_elimination_changes_nothing(seed, k):
    # Five contacts of three axes on eight degrees of freedom: seven inner forces.
    problem = robot(seed, k=k)
    control, least = in_full(problem)
    found = solve_pyramid(problem)
    if found.status == "inactive":
        assert found.control is problem.nominal and cost(problem, found) >= least - 1e-6
    else:
        assert found.status == "projected"
        # No worse, and better by no more than what the large program leaves inexact.
        assert -1e-5 <= cost(problem, found) - least <= 1e-7 * (1.0 + abs(least))
        assert found.control == pytest.approx(control, abs=3e-3)
    assert_says_the_truth(problem, found)


def cost(problem, found):
    away = found.control - problem.nominal
    return 0.5 * (away @ away + problem.force_weight * (found.forces**2).sum())


def assert_says_the_truth(problem, found):
    """Every residual by hand."""
    f, a, u = found.forces, found.acceleration, found.control
    pushed = np.einsum("kiv,ki->v", problem.jacobians, f)
    miss = problem.inertia @ a + problem.bias - problem.actuation @ u - pushed
    scale = 1.0 + np.abs(f).max(initial=0.0) + np.abs(a).max()
    assert np.abs(miss).max() < 1e-8 * scale
    assert (u >= problem.lower).all() and (u <= problem.upper).all()
    assert in_cone(f, problem.normals, problem.friction, 1e-6 * scale).all()
    grips = problem.stance[problem.friction[problem.stance] > 0.0]
    missed = (problem.jacobians @ a - problem.wanted)[grips]
    assert found.contact_error >= np.abs(missed).max(initial=0.0) - 1e-9 * scale
    if found.status in ("projected", "inactive"):
        assert np.abs(missed).max(initial=0.0) < 1e-5 * scale


@by_both
def test_numbers_that_overflow_inside_are_failed_with_a_finite_control(solve):
    found = solve(dataclasses.replace(robot(1), bias=np.full(8, 1.7e308)))
    assert found.status == "failed" and np.isfinite(found.control).all()


# By hand ----------------------------------------------------------------------------------------------------------


def foot(nominal, friction=0.5, mass=2.0, bound=100.0, **more):
    """A point mass that is pushed by three motors and stands on a floor, in newtons: f = m g e_z - u."""
    return WholeBodyProblem(
        inertia=mass * np.eye(3),
        bias=np.array([0.0, 0.0, mass * 9.81]),
        actuation=np.eye(3),
        jacobians=np.eye(3)[None],
        drift=np.zeros((1, 3)),
        normals=UP[None],
        friction=np.array([friction]),
        lower=-np.full(3, bound),
        upper=np.full(3, bound),
        nominal=np.array(nominal, dtype=float),
        **more,
    )


@by_both
def test_a_foot_that_is_pushed_within_its_friction_is_left_alone_bit_for_bit(solve):
    problem = foot([3.0, 1.0, -2.0])
    found = solve(problem)
    assert found.status == "inactive"
    assert found.control is problem.nominal
    assert found.forces[0] == pytest.approx([-3.0, -1.0, 2.0 * 9.81 + 2.0])
    assert found.acceleration == pytest.approx(np.zeros(3), abs=1e-12)


def test_a_foot_that_is_pushed_too_hard_gets_the_closest_push_of_its_cone():
    # Allowed pushes are the cone |u_t| <= mu (m g - u_z) with its apex at m g e_z: its projection is known.
    mu, weight, nominal = 0.5, 19.62, np.array([12.0, 5.0, 3.0])
    found = solve_cone(foot(nominal, mu))
    # Along (radius, height below the apex): the nearest point of the ray (mu, 1).
    sideways, below = np.linalg.norm(nominal[:2]), weight - nominal[2]
    t = (mu * sideways + below) / (1.0 + mu * mu)
    expected = np.array([*(nominal[:2] / sideways * mu * t), weight - t])
    assert found.status == "projected"
    assert found.control == pytest.approx(expected, abs=1e-5)
    assert np.linalg.norm(found.forces[0, :2]) == pytest.approx(mu * found.forces[0, 2], rel=1e-5)


@by_both
def test_what_no_control_does_is_infeasible(solve):
    # The floor is to rise at 3 m/s^2: with motors of 5 N the mass can follow, but sink at 20 it cannot.
    problem = foot([0.0, 0.0, 0.0], bound=5.0, contact_acceleration=np.array([[0.0, 0.0, 3.0]]))
    assert solve(problem).status == "inactive"
    sinking = dataclasses.replace(problem, contact_acceleration=np.array([[0.0, 0.0, -20.0]]))
    found = solve(sinking)
    assert found.status == "infeasible"
    assert found.control is not sinking.nominal and (found.control == sinking.nominal).all()
    assert found.contact_error == pytest.approx(20.0 - 9.81)
    assert_says_the_truth(sinking, found)


def test_wanted_accelerations_that_contradict_each_other_are_infeasible_until_made_attainable():
    one = foot([0.0] * 3)
    apart = dataclasses.replace(  # one point that stands on two, drawn apart
        one,
        **{
            name: np.repeat(getattr(one, name), 2, axis=0)
            for name in ("jacobians", "drift", "normals", "friction")
        },
        contact_acceleration=np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]),
    )
    found = solve_pyramid(apart)
    assert found.status == "infeasible" and found.contact_error > 0.5
    attainable = attainable_contact_acceleration(apart)
    np.testing.assert_allclose(attainable, 0.0, atol=1e-12)
    assert solve_pyramid(dataclasses.replace(apart, contact_acceleration=attainable)).status == "inactive"
    # What is attainable already stays as it is.
    consistent = robot(0, k=3)
    assert attainable_contact_acceleration(consistent) == pytest.approx(consistent.contact_acceleration)


@by_both
def test_a_contact_that_opens_gives_no_force_and_moves_away(solve):
    opening = {"breaking": np.array([True]), "contact_acceleration": np.array([[0.0, 0.0, 1.0]])}
    found = solve(foot([2.0, 0.0, 0.0], **opening))
    assert found.status == "projected"
    assert not found.forces.any()
    # m (g + 1) is the least that lifts; sideways it is free.
    assert found.control == pytest.approx([2.0, 0.0, 2.0 * 10.81], abs=1e-5)
    free = foot([2.0, 0.0, 30.0], **opening)
    assert solve(free).control is free.nominal
    weak = solve(foot([2.0, 0.0, 0.0], bound=10.0, **opening))
    assert weak.status == "infeasible"


@by_both
def test_a_frictionless_contact_holds_along_its_normal_alone(solve):
    found = solve(foot([4.0, 0.0, -1.0], friction=0.0))
    assert found.status == "inactive" and found.contact_error < 1e-12
    assert found.forces[0] == pytest.approx([0.0, 0.0, 20.62])
    assert found.acceleration == pytest.approx([2.0, 0.0, 0.0])
    pulled = solve(foot([0.0, 0.0, 25.0], friction=0.0))
    assert pulled.status == "projected" and pulled.forces[0, 2] >= -1e-6
    assert pulled.control == pytest.approx([0.0, 0.0, 19.62], abs=1e-5)


@pytest.mark.parametrize("lie", ["zeros", "huge", "nothing", "claims infeasible"])
def test_a_backend_is_not_believed(monkeypatch, lie):
    problem = foot([12.0, 5.0, 3.0])

    def backend(program):
        n = program.linear.size
        return {
            "zeros": np.array([0.0, 0.0, 50.0] + [0.0] * (n - 3))[:n],
            "huge": np.full(n, 1e9),
            "nothing": Status.FAILED,
            "claims infeasible": Status.INFEASIBLE,
        }[lie]

    monkeypatch.setattr(whole_body, "by_clarabel", backend)
    found = solve_pyramid(problem)
    assert found.status == ("infeasible" if lie == "claims infeasible" else "failed")
    assert np.isfinite(found.control).all() and (np.abs(found.control) <= 100.0).all()
    assert np.isfinite(found.forces).all() and np.isfinite(found.acceleration).all()
