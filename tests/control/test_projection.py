"""project, in any unit: by the KKT conditions, SciPy and exact fractions; and solvers that lie."""

import math
from fractions import Fraction

import daqp
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from scipy.optimize import Bounds, linprog, lsq_linear, minimize, nnls

from safe_wrappers.control.projection import box_least_squares, cast_inside, keeps_rows, project

SCALES = st.floats(-12.0, 12.0).map(lambda exponent: 10.0**exponent)
SEEDS = st.integers(0, 2**31)


def kkt_residual(u, normals, offsets, lower, upper, x):
    """By how much the way to an answer is no sum of outward normals of rows and bounds that hold."""
    unit, reach = np.eye(u.size), 1e-9 * (1.0 + np.abs(x).max())
    lengths = np.maximum(np.linalg.norm(normals, axis=1), 1e-300)
    holds = (normals @ x - offsets) / lengths > -reach
    outward = [(normals / lengths[:, None])[holds], unit[x >= upper - reach], -unit[x <= lower + reach]]
    return nnls(np.vstack(outward).T, u - x)[1]


def room(normals, offsets, lower, upper):
    """By how much the best control in the box keeps every row (below 0: misses one), in lengths of the normals."""
    lengths = np.linalg.norm(normals, axis=1)
    if (offsets[lengths == 0.0] < 0.0).any():
        return -math.inf
    cost = np.append(np.zeros(normals.shape[1]), -1.0)
    bounds = [*zip(lower, upper, strict=True), (None, 10.0)]
    return linprog(cost, np.hstack([normals, lengths[:, None]]), offsets, bounds=bounds).x[-1]


def violations(normals, offsets, x):
    lengths = np.linalg.norm(normals, axis=1)
    return np.maximum(normals @ x - offsets, 0.0) / np.where(lengths > 0.0, lengths, 1.0)


@st.composite
def problems(draw):
    """Nominal, rows and a box of order one; feasible or not, some entries zero, some components without bounds."""
    rng = np.random.default_rng(draw(SEEDS))
    size, rows = draw(st.sampled_from([1, 2, 3, 7, 17])), draw(st.sampled_from([1, 2, 5, 20]))
    normals = rng.normal(size=(rows, size)) * (rng.random((rows, size)) < draw(st.sampled_from([0.7, 1.0])))
    left = rng.normal(draw(st.sampled_from([0.2, -0.1])), draw(st.sampled_from([0.05, 0.3])), rows)
    offsets = normals @ rng.uniform(-0.9, 0.9, size) + left
    lower, upper = -rng.uniform(0.2, 1.0, size), rng.uniform(0.2, 1.0, size)
    open_ended = rng.random(size) < draw(st.sampled_from([0.0, 0.3, 1.0]))
    nominal = draw(st.sampled_from([0.2, 1.2, 3.0])) * rng.uniform(-1.0, 1.0, size)
    return nominal, normals, offsets, lower, np.where(open_ended, np.inf, upper)


@settings(max_examples=80)
@given(problems(), SCALES, st.booleans())
def test_it_is_the_closest_admissible_control_or_violates_least_in_any_unit(problem, scale, in_the_rows):
    u, normals, offsets, lower, upper = problem
    feasible = room(*problem[1:])
    assume(abs(feasible) > 1e-6)  # on the edge, rounding decides
    answer = project(*problem)
    rows = (normals / scale, offsets) if in_the_rows else (normals, offsets * scale)
    other = project(u * scale, *rows, lower * scale, upper * scale)
    assert (lower <= answer.control).all() and (answer.control <= upper).all()
    assert answer.violation == pytest.approx(max(0.0, (normals @ answer.control - offsets).max()))
    assert other.status == answer.status
    np.testing.assert_allclose(other.control / scale, answer.control, atol=1e-6)
    kept = bool((normals @ u <= offsets).all() and (lower <= u).all() and (u <= upper).all())
    assert answer.status == ("infeasible" if feasible < 0.0 else "inactive" if kept else "projected")
    if kept:
        assert answer.control.tobytes() == u.tobytes() and answer.violation == 0.0
        assert other.control.tobytes() == (u * scale).tobytes()
    elif feasible > 0.0:
        assert keeps_rows(other.control, *rows, lower * scale, upper * scale)
        assert not keeps_rows(u * scale, *rows, lower * scale, upper * scale)
        assert kkt_residual(*problem, answer.control) < 1e-7
    else:
        squares = lambda x: float((violations(normals, offsets, x) ** 2).sum())  # noqa: E731
        least = minimize(
            squares, 0.0 * u, bounds=Bounds(lower, upper), options={"ftol": 1e-14, "gtol": 1e-10}
        )
        assert squares(answer.control) <= least.fun + 1e-6


@pytest.mark.parametrize("open_ended", [False, True])
@example(391, 2, 5)  # in one unit these two are lost
@example(395, 4, 8)
@given(SEEDS, st.integers(2, 5), st.integers(1, 8))
def test_components_of_very_different_width(open_ended, seed, size, rows):
    # A feasible point inside: one unit for all components once left narrow ones to the solver's tolerance.
    rng = np.random.default_rng(seed)
    width = 10.0 ** rng.uniform(-4.0, 4.0, size)
    normals = rng.normal(size=(rows, size)) / width
    lengths = np.linalg.norm(normals * width, axis=1)
    offsets = normals @ (width * rng.uniform(-0.5, 0.5, size)) + lengths * rng.uniform(0.2, 1.0, rows)
    upper = np.where(np.arange(size) < open_ended, np.inf, width)
    answer = project(width * rng.uniform(-1.0, 1.0, size), normals, offsets, -width, upper)
    assert answer.status in ("inactive", "projected")
    assert keeps_rows(answer.control, normals, offsets, -width, upper)


# Examples: rows that are degenerate, contradictory, far away or no numbers ----------------------------------------

HIGH, EYE, PAIR, AXIS = [0.9, 0.9], np.eye(2), [0.2, 0.3], np.array([0.6, 0.8])
NARROW = np.array([[-0.1, -0.002, -900.0], [0.3, 0.0065, 990.0]])
NORMALS, OFFSETS, NOMINAL = np.array([[1.0, 0.3], [0.2, 1.0]]), np.array([-0.4, -0.5]), np.array([0.9, 0.8])


def more(row, offset, count):
    """A row before `count` others that ask for 0.2 and 0.3."""
    return HIGH, np.vstack([row, EYE[:count]]), [offset, *PAIR[:count]], -1.0, 1.0


EXAMPLES = [
    # One component is fought over, the other one is free: it stays what the policy asked for.
    (([0.0, 0.3], [[1.0, 0.0], [-1.0, 0.0]], [-0.5, -0.5], -1, 1), "infeasible", [0.0, 0.3]),
    # Bug 4: barriers far beyond the box do not soften it.
    (([0.4, 0.4], [[1.0, 0.0]], [-5.0], -1, 1), "infeasible", [-1.0, 0.4]),
    (([0.4, 0.4], EYE, [-5.0, -7.0], -1, 1), "infeasible", [-1.0, -1.0]),
    (([0.4, 0.4], [[1, 0.2], [0.1, 1], [1, 1]], [-50.0, -70.0, -9.0], -1, 1), "infeasible", [-1.0, -1.0]),
    # Bug 1: 0 <= 1 made others' filter return the unsafe nominal and report success.
    (more([0.0, 0.0], 1.0, 2), "projected", PAIR),
    # Where a zero row is violated the others still hold.
    *((more([0.0, 0.0], -1.0, k), "infeasible", PAIR[:k] + HIGH[k:]) for k in (0, 1, 2)),
    *(
        (([0.0], [[scale], [-scale]], [-0.1 * scale, -0.3 * scale], -1, 1), "infeasible", [0.1])
        for scale in (1e-4, 1.0, 1e4)
    ),
    (([0.5, 0.5], [[1, 1], [1, -1]], [0.4, 0.9], [-1.0, 0.2], [1.0, 0.2]), "projected", [0.2, 0.2]),
    *(
        (([0.9, 0.1], scale * EYE, [0.5 * scale] * 2, -1, 1), "projected", [0.5, 0.1])
        for scale in (1e-200, 1e-140, 1e-9, 1e9, 1e140, 1e200)
    ),
    # A tolerance that grew with the nominal answered 1.0.
    (([1e9], [[1.0]], [0.5], -1, 1), "projected", [0.5]),
    # A share of a box that is far away would be more than the control itself.
    *(
        ((NOMINAL, EYE[:rows], [0.9 - 1e-6, 0.5][:rows], -b, b), "projected", [0.9 - 1e-6, [0.8, 0.5][rows - 1]])
        for b in (1e3, 1e5, 1e10, 1e20, 3.4e38, math.inf)
        for rows in (1, 2)
    ),
    # Two components end at a bound; the third carries the rest with a hundred-thousandth of the first's slope.
    (
        ([0.2, 0.0, -1e3], [[640, -11e3, -0.0855]], [-130.0], NARROW[0], NARROW[1]),
        "projected",
        [-0.1, 0.0065, (640.0 * -0.1 - 11000.0 * 0.0065 + 130.0) / 0.0855],
    ),
    # By less than an answer may miss them, parallel rows may contradict each other.
    *(
        (([0.5, 0.9], np.outer([1, -1], AXIS), [0.3 + gap, -0.3], -1, 1), status, [0.068, 0.324] + gap * AXIS)
        for gap, status in ((1e-6, "projected"), (1e-12, "projected"), (-1e-9, "projected"), (-1e-6, "infeasible"))
    ),
    # Asks for nothing.
    *((more([1.0, 0.5], math.inf, k), "projected" if k else "inactive", PAIR[:k] + HIGH[k:]) for k in (0, 1, 2)),
    *((more([1.0, 0.5], bad, k), "failed", HIGH) for k in (0, 1, 2) for bad in (math.nan, -math.inf)),
    *((more([b, 0.5], 2.0, k), "failed", HIGH) for k in (0, 1, 2) for b in (math.nan, math.inf, -math.inf)),
]  # fmt: skip


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize(("problem", "status", "control"), EXAMPLES)
def test_examples(problem, status, control):
    answer = project(*problem)
    assert answer.status == status
    tolerance = {"inactive": 0.0, "projected": 1e-8, "infeasible": 1e-4, "failed": 0.0}[status]
    np.testing.assert_allclose(answer.control, control, rtol=1e-9, atol=tolerance)
    _, normals, offsets, lower, upper = problem
    missed = np.max(normals @ answer.control - offsets, initial=0.0)
    assert answer.violation == (math.inf if status == "failed" else pytest.approx(missed))
    assert (answer.control >= lower).all() and (answer.control <= upper).all()


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("bound", [1.0, math.inf])
@pytest.mark.parametrize("rows", [1, 2])
def test_an_answer_that_overflows_is_none(rows, bound):
    answer = project([0.3, 0.3], np.eye(2)[:rows] * 1e-140, np.full(rows, -1e299), -bound, bound)
    assert answer.status in ("infeasible", "failed")
    assert np.isfinite(answer.control).all() and (np.abs(answer.control) <= bound).all()
    for sign, status in ((1.0, "inactive"), (-1.0, "failed")):  # the sum of the offsets does
        assert project([0.3, 0.3], np.eye(2), [sign * 1e308] * 2, -1.0, 1.0).status == status


@pytest.mark.parametrize("scale", [1e-9, 1e-3, 1e3, 1e9])
@pytest.mark.parametrize("rows", [1, 2])
def test_a_nominal_on_the_boundary_to_rounding_is_inactive_in_every_unit(scale, rows):
    u, normals = np.array([0.3, 0.4]) * scale, np.array([[0.6, 0.8], [0.8, -0.6]])[:rows]
    for miss, status in ((-1e-12, "inactive"), (1e-12, "inactive"), (1e-6, "projected")):
        answer = project(u, normals, normals @ u - miss * scale, -scale, scale)
        assert answer.status == status
        assert status == "projected" or answer.control.tobytes() == u.tobytes()


def test_what_cannot_be_checked_is_not_kept():
    one = np.ones(1)
    for row, offset, bound in ((1e200, 1.0, 1.0), (math.nan, 1.0, 1.0), (1.0, -math.inf, 1e3)):
        assert not keeps_rows(one, np.array([[row]]), offset * one, -bound * one, bound * one)


# Thin wedges ------------------------------------------------------------------------------------------------------


def apex(normals, offsets):
    """Where two rows meet, exactly, for the numbers as they are stored."""
    (a, b), (c, d) = [[Fraction(v) for v in row] for row in normals.tolist()]
    e, f = map(Fraction, offsets.tolist())
    determinant = a * d - b * c
    return np.array([float((e * d - b * f) / determinant), float((a * f - e * c) / determinant)])


@given(st.floats(-5.0, -1.0), st.floats(0.0, 6.28), st.floats(0.05, 0.4), st.floats(-0.3, 0.3), SCALES)
@example(-5.0, 0.7, 0.4, 0.1, 1.0)
def test_the_apex_of_a_thin_wedge_is_found(exponent, turn, back, aside, scale):
    angle = 10.0**exponent
    one = np.array([math.cos(turn), math.sin(turn)])
    other = -np.array([math.cos(turn + angle), math.sin(turn + angle)])
    normals, tip = np.stack([one, other]), np.array([0.2, -0.1]) * scale
    offsets = normals @ tip
    along = np.array([-one[1], one[0]])
    inward = along if other @ along < 0.0 else -along
    nominal = tip + (aside * one - back * inward) * scale  # behind the tip: the tip is the closest control
    assume((normals @ nominal - offsets).max() > 1e-8 * scale)  # less counts as admissible
    answer = project(nominal, normals, offsets, -scale, scale)
    assert answer.status == "projected"
    # The stored rows fix the tip to a rounding over the angle.
    assert np.linalg.norm(answer.control - apex(normals, offsets)) <= (1e-9 + 1e-14 / angle) * scale


@pytest.mark.parametrize("angle", [1e-6, 1e-7, 1e-8, 1e-10])
def test_of_a_wedge_too_thin_for_the_solver_nothing_wrong_is_said(angle):
    normals = np.array([[1.0, 0.0], [-math.cos(angle), -math.sin(angle)]])
    offsets = normals @ [0.2, -0.1]
    answer = project([0.3, 0.2], normals, offsets, -1.0, 1.0)
    missed = (normals @ answer.control - offsets).max()
    assert answer.status == ("projected" if missed <= 1e-8 else "infeasible")
    assert 0.0 <= answer.violation == max(missed, 0.0) < 1e-6


# Solvers ----------------------------------------------------------------------------------------------------------

LIES = {
    "nan called found": ([np.nan, np.nan], 1),
    "infinite called found": ([np.inf, 0.0], 1),
    "zero called infeasible": ([0.0, 0.0], -1),
    "infeasible point called found": ([0.0, 0.0], 1),
    "the nominal called found": ([0.9, 0.8], 1),
    "outside of the box called found": ([-30.0, 2.45], 1),
    "feasible point that is not the closest called found": ([-1.0, -1.0], 1),
    "limit of iterations": ([0.0, 0.0], -4),
}


@pytest.mark.parametrize("lies", [1, math.inf])
@pytest.mark.parametrize("lie", LIES)
def test_daqp_is_not_believed(monkeypatch, lie, lies):
    truth, asked, real = project(NOMINAL, NORMALS, OFFSETS, -1.0, 1.0), [], daqp.solve

    def lying(h, f, *rows, **options):
        asked.append(f)
        point, flag = LIES[lie]
        return (np.array(point), 0.0, flag, {}) if len(asked) <= lies else real(h, f, *rows, **options)

    with monkeypatch.context() as patch:
        patch.setattr(daqp, "solve", lying)
        assert project([0.1, 0.2], EYE, [0.5, 0.5], -1.0, 1.0).status == "inactive" and not asked
        answer = project(NOMINAL, NORMALS, OFFSETS, -1.0, 1.0)
    missed = (NORMALS @ answer.control - OFFSETS).max()
    assert (np.abs(answer.control) <= 1.0).all()
    assert answer.violation == pytest.approx(max(0.0, missed))
    assert (answer.status == "projected") == (missed <= 1e-9)
    if lies == math.inf or lie.startswith("feasible"):
        assert lie.startswith("feasible") == (missed <= 0.0)
    else:  # the softened rows have the right answer
        assert len(asked) == 2
        np.testing.assert_allclose(answer.control, truth.control, atol=1e-8)
    after = project(NOMINAL, NORMALS, OFFSETS, -1.0, 1.0)  # and the next call knows nothing of it
    assert truth.status == "projected" and after.control.tobytes() == truth.control.tobytes()


@given(st.integers(0, 6), st.integers(0, 6), SEEDS, SCALES)
def test_box_least_squares_agrees_with_scipy_in_any_unit(n, more, seed, scale):
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(n + more, n)), 3.0 * rng.normal(size=n + more)
    a[:n] += np.eye(n)
    low, high = -rng.random(n) - 0.01, rng.random(n) + 0.01
    ours = box_least_squares(a, b * scale, low * scale, high * scale) / scale
    assert ours.shape == (n,)
    assert ((ours * scale >= low * scale) & (ours * scale <= high * scale)).all()
    if n:
        truth = lsq_linear(a, b, (low, high), tol=1e-12).x
        assert np.linalg.norm(a @ ours - b) <= np.linalg.norm(a @ truth - b) + 1e-6


def test_a_control_beyond_the_action_s_dtype_is_cast_to_its_largest_number():
    far = np.array([1e300, -1e39, 0.5])
    sent = cast_inside(
        far, np.float32, np.zeros((0, 3)), np.zeros(0), np.full(3, -np.inf), np.full(3, np.inf)
    )
    most = np.finfo(np.float32).max
    assert sent.dtype == np.float32 and sent.tolist() == [most, -most, 0.5]


@given(SEEDS, st.integers(1, 4))
def test_a_cast_control_stays_inside_its_row_and_moves_no_other_component(seed, n):
    rng = np.random.default_rng(seed)
    control, normal = rng.uniform(-1.0, 1.0, n), rng.normal(size=(1, n)) * (rng.random(n) < 0.7)
    offset = normal @ control
    sent = cast_inside(control, np.float32, normal, offset, -np.ones(n), np.ones(n))
    assert sent.dtype == np.float32 and (normal @ sent.astype(np.float64) <= offset).all()
    np.testing.assert_allclose(sent, control, rtol=2e-7)
    np.testing.assert_array_equal(sent[normal[0] == 0.0], control[normal[0] == 0.0].astype(np.float32))
