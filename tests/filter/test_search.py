"""The search for an admissible action, stage by stage: what each one tries, in which order, and what it refuses.

Bound constraints whose every answer is given, and a search over two controls in [-1, 1].
"""

from types import SimpleNamespace
from typing import Any, NamedTuple

import daqp
import gymnasium as gym
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import safe_wrappers as sw
from safe_wrappers.filter import engine
from safe_wrappers.filter.bound import Bound
from safe_wrappers.filter.fallback import Fallback
from safe_wrappers.filter.linearize import Tangents, differences
from safe_wrappers.filter.search import SafeActionSearch, Stage

LAST = np.zeros(2)


class Still(gym.Env):
    """Two controls, and a state that never changes."""

    dt = 0.1
    observation_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)

    def __init__(self, dtype=np.float64):
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), dtype)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1), {}

    def step(self, action):
        return np.zeros(1), 0.0, False, False, {}


class StillPlant(sw.AnalyticPlant):
    """Its state never changes; controls act between `acting`, or all between the bounds."""

    acting_range = None


def still_plant(acting=None):
    plant = StillPlant(lambda x: 0.0 * x, lambda x: np.zeros((1, 2)), lambda env: np.zeros(1))
    plant.acting_range = acting and tuple(map(np.array, acting))
    return plant


def half_spaces(*rows):
    """Rows ((a0, a1), b): a . u <= b."""
    return sw.HalfSpaces(
        np.array([a for a, _ in rows], float).reshape(-1, 2), np.array([b for _, b in rows], float)
    )


class Given(Bound):
    """It observes nothing and remembers nothing."""

    spec, plant, least, may_back_up = SimpleNamespace(scale=1.0, info_keys=()), None, np.inf, False

    def observe(self, memory):
        pass

    def executed(self, control):
        return {}

    def candidates(self, control):
        return ()

    def backup(self):
        return None


class Rows(Given):
    """Rows alone."""

    predicts, rows_decide = False, True

    def __init__(self, *rows):
        self._own = half_spaces(*rows)

    def admits(self, control):
        return bool((self._own.normals @ control <= self._own.offsets + 1e-9).all())

    def rows(self):
        return self._own


class Predicting(Given):
    """A slack of the control is all that counts; rows, tangents, candidates and backup are given.

    Args:
        slack: Control (2,) to its slack.
        guess: Rows that the search takes for a guess.
        tangents: Refused control to rows; None: it cannot be linearised.
        candidates: Controls to try first.
        control: The backup control, or None.
        scale: Of the slack.
    """

    predicts, rows_decide = True, False

    def __init__(self, slack, guess=(), tangents=None, candidates=(), control=None, scale=1.0):
        self.spec, self.may_back_up = SimpleNamespace(scale=scale, info_keys=()), control is not None
        self._slack, self._guess, self._tangents = slack, half_spaces(*guess), tangents
        self._candidates, self._control = candidates, control

    def admits(self, control):
        return self.slack(control) >= -1e-9

    def keeps_limit(self, control):
        return False

    def slack(self, control):
        return float(self._slack(control))

    def rows(self):
        return self._guess

    def linearize(self, control):
        return half_spaces(*(() if self._tangents is None else self._tangents(control)))

    def candidates(self, control):
        return [np.array(c) for c in self._candidates]

    def backup(self):
        return None if self._control is None else np.array(self._control)


def only(*controls):
    """A slack that admits these controls and no others."""
    return lambda u: 1.0 if any(np.allclose(u, c, atol=1e-6) for c in controls) else -1.0


def search(*constraints, fallback="brake", acting=None):
    plant = still_plant(acting)
    plant.bind(Still())
    plant.observe()
    return SafeActionSearch(plant, constraints, Fallback(fallback, constraints), -np.ones(2), np.ones(2))


def decide(proposal, *constraints, **options):
    return search(*constraints, **options).decide(np.array(proposal, float), LAST)


NONE = np.zeros((0, 2)), np.zeros(0)
"""No rows to keep."""
LEFT = Rows(((1.0, 0.0), 0.0))
"""The first control is at most 0."""
STRICT = np.array([[1.0, 0.0]]), np.zeros(1)
"""Its row."""


def at_least(limit):
    return [((-1.0, 0.0), -limit)]


def at_most(limit):
    return [((1.0, 0.0), limit)]


def keeps(decision, *expected):
    np.testing.assert_allclose(decision.control, expected, atol=1e-9)


# The order --------------------------------------------------------------------------------------------------------

PROPOSED, BACKUP, FALLBACK = (1.0, 1.0), (-1.0, -1.0), (0.0, -1.0)
LADDER = [
    (Stage.PROPOSAL, PROPOSED),
    (Stage.CANDIDATE, (0.9, 0.8)),
    (Stage.CANDIDATE, (0.8, 0.9)),
    (Stage.ROWS, (0.5, 1.0)),
    (Stage.RELINEARIZED, (0.3, 1.0)),
    (Stage.OVERSHOOT, (0.286, 1.0)),  # 2 % more of 0.7
    (Stage.OVERSHOOT, (0.23, 1.0)),  # 10 % more
    (Stage.BLEND, (0.17, 0.8)),  # of the last answer, (0.3, 1), and the backup: 10 %
    (Stage.BLEND, (-0.025, 0.5)),
    (Stage.BLEND, (-0.35, 0.0)),
    (Stage.BLEND, (-0.675, -0.5)),
    (Stage.BLEND, (0.3, -1.0)),  # the backup but for the first component
    (Stage.BLEND, (-1.0, 1.0)),  # but for the second
    (Stage.BACKUP, BACKUP),
    (Stage.FALLBACK, FALLBACK),
]


@pytest.mark.parametrize("first", range(len(LADDER)), ids=[f"{s.name} {u}" for s, u in LADDER])
def test_the_first_stage_that_finds_an_admitted_control_answers(first):
    constraint = Predicting(
        only(*(u for _, u in LADDER[first:])),
        guess=at_most(0.5),
        tangents=lambda u: at_most(0.3),
        candidates=[(0.9, 0.8), (0.8, 0.9)],
        control=BACKUP,
    )
    decision = decide(PROPOSED, constraint, fallback=lambda plant: np.array(FALLBACK))
    stage, control = LADDER[first]
    keeps(decision, *control)
    assert decision.stage is stage
    assert not decision.infeasible
    assert decision.fallback == (stage is Stage.FALLBACK)
    assert decision.changed == (first > 0)
    assert (decision.refused is None) if first == 0 else decision.refused.tolist() == [True]


def test_changes_are_counted_in_shares_of_what_acts():
    # The first control saturates at 0.5: in shares of what acts it costs twice as much to change.
    decision = decide((1.0, 1.0), Rows(((1.0, 1.0), 0.5)), acting=((-0.5, -1.0), (0.5, 1.0)))
    keeps(decision, 0.3, 0.2)
    # What saturates as the proposal did stays the proposal's.
    decision = decide((1.0, 1.0), Rows(((0.0, 1.0), 0.5)), acting=((-0.5, -1.0), (0.5, 1.0)))
    keeps(decision, 1.0, 0.5)


# What constraints offer -------------------------------------------------------------------------------------------


def test_the_first_that_keeps_the_rows_and_every_prediction_is_taken_clipped_to_the_box():
    offers, other = [(0.5, 0.0), (-0.5, 0.9), (-9.0, 0.1), (-0.3, 0.0)], Predicting(lambda u: 0.5 - u[1])
    found = search(Predicting(lambda u: 1.0, candidates=offers), other).candidate(np.ones(2), STRICT)
    np.testing.assert_array_equal(found, [-1.0, 0.1])
    backups = [Predicting(lambda u: 1.0, control=c) for c in (None, *offers)]
    np.testing.assert_array_equal(search(*backups, other).backup(STRICT), [-1.0, 0.1])
    refused = search(Predicting(only(), candidates=offers, control=(0.0, 0.0)))
    assert refused.candidate(np.ones(2), NONE) is None and refused.backup(NONE) is None


@pytest.mark.parametrize("offered", [np.nan, np.inf, -np.inf, 5.0])
def test_what_is_not_finite_or_outside_of_the_box_is_not_executed(offered):
    judged = []

    def slack(u):
        judged.append(u)
        return -1.0 if u[0] == 0.9 else 0.0

    decision = decide((0.9, 0.9), Predicting(slack, candidates=[(offered, 0.0)], control=(0.0, offered)))
    assert decision.changed and not decision.infeasible
    assert all((np.abs(u) <= 1.0).all() for u in (decision.control, *judged))


# Linearising anew -------------------------------------------------------------------------------------------------


def creeping(slack):
    """Every linearisation asks for a step of 0.1 to the left."""
    return Predicting(slack, tangents=lambda u: at_most(u[0] - 0.1))


@pytest.mark.parametrize("steps", [1, 5, 6, 7])
def test_a_refused_control_is_linearised_up_to_six_times(steps):
    decision = decide((1.0, 1.0), creeping(lambda u: 1.0001 - 0.1 * steps - u[0]))
    assert decision.infeasible == (steps > 6)
    if steps <= 6:
        assert decision.stage is Stage.RELINEARIZED
        keeps(decision, 1.0 - 0.1 * steps, 1.0)


def test_provisional_tangents_give_way_to_the_next_ones():
    limits, provisional = iter([0.9, -0.5, 0.6]), iter([False, True, True])

    class Guessing(Predicting):
        def linearize(self, control):
            return sw.HalfSpaces(np.array([[1.0, 0.0]]), np.array([next(limits)]), next(provisional))

    decision = decide((1.0, 1.0), Guessing(only((0.6, 1.0))))
    assert decision.stage is Stage.RELINEARIZED
    keeps(decision, 0.6, 1.0)


# Shortening -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("limit", "rows", "found"),
    [(0.5, NONE, 0.475), (0.0, NONE, -0.05), (-0.6, NONE, -0.68), (0.5, STRICT, -0.2625)],
)
def test_an_admitted_correction_is_shortened_to_what_is_needed(limit, rows, found):
    """By 5 % of the violation beyond the boundary; halfway where that breaks the rows."""
    nearer = search(Predicting(lambda u: limit - u[0])).shorten(np.ones(2), np.array([-1.0, 1.0]), rows)
    np.testing.assert_allclose(nearer, [found, 1.0])


def test_more_of_a_correction_that_contradicts_the_rows_is_no_overshoot():
    to_the_point = np.array([[1.0, 0.0], [-1.0, 0.0]]), np.array([0.5, -0.5])
    assert search(Predicting(lambda u: 1.0)).overshoot(np.ones(2), to_the_point) is None


# Rows that contradict each other ----------------------------------------------------------------------------------
# The least violation of "at most 0" and "at least 0.5" is 0.25. A prediction that asks for 0.2 would let it through.


@pytest.mark.parametrize("before", [0, 2, 5])
def test_tangents_against_rows_let_nothing_through_that_breaks_the_rows(before):
    asked = iter([0.1] * before + [0.5] * 9)
    contradicting = Predicting(lambda u: u[0] - 0.2, tangents=lambda u: at_least(next(asked)))
    decision = decide((0.0, 0.0), contradicting, LEFT, fallback="zero")
    assert decision.stage is Stage.FALLBACK and decision.infeasible and decision.fallback
    keeps(decision, 0.0, 0.0)


def test_where_the_solver_has_no_answer_the_fallback_acts(monkeypatch):
    monkeypatch.setattr(daqp, "solve", lambda hessian, linear, *rows, **options: (linear, 0.0, -4, {}))
    decision = decide((0.9, 0.8), Rows(((1.0, 0.2), 0.3), ((-0.3, 1.0), 0.2)))
    assert decision.stage is Stage.FALLBACK and decision.fallback and not decision.infeasible


# One decision each ------------------------------------------------------------------------------------------------


def opposed(scale):
    """More of the first control is worse for one constraint and better for another; no control will do."""
    more = Predicting(lambda u: -10.0 * (1.0 + u[0]), at_most(0.0), scale=scale)
    return more, Predicting(lambda u: 0.5 * u[0] - 1.0)


class Case(NamedTuple):
    """Constraints, which stage answers and with what; infeasible or not, of which proposal, after which fallback."""

    constraints: Any
    stage: Stage
    control: tuple[float, float]
    infeasible: bool = False
    proposal: tuple[float, float] = (1.0, 0.5)
    fallback: Any = "brake"


class InMargin(Predicting):
    """A first control of more, or else of less, keeps the limit itself."""

    def __init__(self, more):
        super().__init__(lambda u: u[0] - 2.0, at_most(0.0))
        self.keeps_limit = lambda control: (control[0] > 0.5) == more


BALANCE = Predicting(lambda u: sum(u) - 0.5, [((-1.0, -1.0), -0.5)])
NO_NUMBERS = lambda u: [((np.nan, 0.0), 0.3), *at_most(0.3)]  # noqa: E731
CONTRADICTION, NAN_ROW = at_least(0.5) + at_most(0.0), Rows(((np.nan, 0.0), 0.0))
ROWS, ANEW, BLEND, STOP, LEAST = Stage.ROWS, Stage.RELINEARIZED, Stage.BLEND, Stage.FALLBACK, Stage(8)
CASES = {
    "rows that a prediction admits are not guessed at": Case(
        [LEFT, Predicting(lambda u: 1.0, at_most(-0.5))], ROWS, (0.0, 0.5)
    ),
    "unless the answer is refused": Case(
        [LEFT, Predicting(lambda u: -0.4 - u[0], at_most(-0.5))], ROWS, (-0.5, 0.5)
    ),
    "what rows make of an admitted proposal is asked about too": Case(
        [LEFT, BALANCE], ROWS, (0.0, 0.5), proposal=(1.0, 0.2)
    ),
    # The other row is kept, and the answer would be admitted; it is not taken for the answer of a projection.
    "tangents that are no numbers end it": Case(
        [Predicting(lambda u: 0.5 - u[0], tangents=NO_NUMBERS, control=(-1.0, 0.5))], BLEND, (0.475, 0.5)
    ),
    "a fallback that is admitted is shortened": Case(
        [Predicting(lambda u: 0.5 - u[0])], BLEND, (0.475, 0.5), fallback=lambda plant: np.array([-1.0, 0.5])
    ),
    "a guess against rows is dropped": Case(
        [Predicting(lambda u: -0.2 - u[0], at_least(0.5), lambda u: at_most(-0.3)), LEFT], ANEW, (-0.3, 0.5)
    ),
    "so is one that contradicts itself": Case(
        [Predicting(lambda u: 0.9001 - u[0], CONTRADICTION, lambda u: at_most(0.9))], ANEW, (0.9, 0.5)
    ),
    # Even where the prediction would admit it.
    "its least violation, 0.25, is not executed": Case(
        [Predicting(lambda u: -abs(u[0] - 0.25) + 0.1, at_least(0.5)), LEFT], STOP, (0.0, 0.5), True
    ),
    "tangents that contradict each other are only guesses": Case(
        [Predicting(lambda u: 0.3 - u[0], tangents=lambda u: CONTRADICTION)], ANEW, (0.25, 0.5)
    ),
    # Nothing brakes here: the fallback violates the rows least.
    "rows that contradict each other": Case([Rows(*CONTRADICTION)], STOP, (0.25, 0.5), True),
    "also where a prediction refuses the proposal": Case(
        [Rows(*CONTRADICTION), Predicting(lambda u: 0.1 - u[0])], STOP, (0.25, 0.5), True
    ),
    "rows that are no numbers are a failure and no contradiction": Case([NAN_ROW], STOP, (0.0, 0.0)),
    "also with a prediction": Case([NAN_ROW, Predicting(only())], STOP, (0.0, 0.0)),
    "a fallback that is admitted": Case([Predicting(only((0, 0)))], STOP, (0.0, 0.0), fallback="zero"),
    "one that is not": Case([Predicting(only((0.3, 0.3)))], STOP, (0.0, 0.0), True, fallback="zero"),
    "in shares of the scales the proposal violates least": Case(opposed(100.0), LEAST, (1.0, 0.5), True),
    "or the farthest that was tried": Case(opposed(1.0), LEAST, (-0.1, 0.5), True),
    "what was chosen is executed whatever it violates": Case(
        opposed(100.0), STOP, (0.0, 0.0), True, fallback="zero"
    ),
    "the fallback may violate least itself": Case(
        [Predicting(lambda u: -1.0 - abs(u[0]), at_most(0.0))], STOP, (0.0, 0.5), True
    ),
    "inside the margin what violates it least may keep the limit": Case([InMargin(True)], LEAST, (1.0, 0.5)),
    "or the fallback does": Case([InMargin(False)], STOP, (0.0, 0.5)),
    # The proposal, tried first, violates the prediction least, and the rows.
    "the least violation keeps the rows": Case(
        [Predicting(lambda u: u[0] - 2.0), LEFT], STOP, (0.0, 0.5), True
    ),
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_a_decision(case):
    decision = decide(case.proposal, *case.constraints, fallback=case.fallback)
    keeps(decision, *case.control)
    assert decision.stage is case.stage and decision.infeasible == case.infeasible and decision.changed
    assert decision.fallback == (case.stage >= Stage.FALLBACK)
    assert decision.refused.tolist() == [not c.admits(case.proposal) for c in case.constraints]


# What the wrapper reports -----------------------------------------------------------------------------------------


class Fake(sw.Constraint):
    """A specification that becomes what it is given."""

    def __init__(self, bound):
        self.bound = bound


def filtered(monkeypatch, bound, dtype):
    monkeypatch.setattr(engine, "Bound", lambda constraint, plant: constraint.bound)
    return sw.CBFActionFilter(Still(dtype), [Fake(bound)], plant=still_plant())


@pytest.mark.filterwarnings("ignore:the policy's action is not finite")
@pytest.mark.parametrize(("first", "stage"), [(-0.5, 0), (0.5, 1), (np.nan, 7)])
def test_info_says_which_stage_answered(monkeypatch, first, stage):
    env = filtered(monkeypatch, LEFT, np.float64)
    assert list(Stage) == list(range(9))
    assert env.reset(seed=0)[1]["cbf/stage"] == 0
    assert env.step(np.array([first, 0.0]))[4]["cbf/stage"] == stage


def test_what_is_executed_is_what_was_judged(monkeypatch):
    judged = []

    def slack(u):
        judged.append(tuple(u))
        return 1.0 / 3.0 - u[0] * u[0] - 0.1 * u[1]

    def tangents(u):
        value = slack(u)
        return [((2.0 * u[0], 0.1), value + 2.0 * u[0] * u[0] + 0.1 * u[1])]

    env = filtered(monkeypatch, Predicting(slack, tangents=tangents), np.float32)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(30):
        executed = env.step(rng.uniform(-1.0, 1.0, 2).astype(np.float32))[4]["executed_action"]
        assert tuple(executed) in judged and slack(executed) >= -1e-9
        np.testing.assert_array_equal(executed, executed.astype(np.float32))


def test_a_fallback_in_place_of_a_proposal_is_filtered_like_one():
    found = search(LEFT, fallback=lambda plant: np.array([0.7, 0.3]))
    decision = found.without_proposal(LAST)
    keeps(decision, 0.0, 0.3)
    assert decision.stage is Stage.FALLBACK and decision.fallback and decision.changed
    assert decision.refused is None and not decision.infeasible
    # A state that is not a number says nothing about any control: then it is not.
    keeps(found.unreadable(LAST), 0.7, 0.3)


# Tangents: by differences, and by secants that explain what was seen ----------------------------------------------

NUMBERS = st.floats(-3.0, 3.0)


def tangents(slacks, made=None, rows=None):
    """Of slacks of two controls; `made` counts the differences, of which the first `rows` are given."""

    def slopes(control):
        if made is not None:
            made.append(control)
        return differences(slacks, control, -np.ones(2), np.ones(2))[:rows]

    return Tangents(slacks, slopes)


def curved(u):
    return np.array([-1.0 - u[0] ** 2, -2.0 + u[0] * u[1]])


def test_after_two_secants_differences_are_made_anew_and_not_five_times_nor_for_the_same_control():
    made, rng = [], np.random.default_rng(0)
    found = tangents(curved, made)
    rows = [found.about(u) for u in rng.uniform(-1.0, 1.0, (14, 2))]
    assert [r.provisional for r in rows[:12]] == [False, True, True] * 4
    assert len(made) == 4 and not rows[12].offsets.size and not rows[13].offsets.size
    again = tangents(curved)
    assert [again.about(np.array([0.1, 0.2])).offsets.size for _ in range(2)] == [2, 0]


@given(first=arrays(float, 2, elements=NUMBERS), second=arrays(float, 2, elements=NUMBERS))
def test_a_secant_explains_the_change_and_leaves_other_directions_alone(first, second):
    step = second - first
    assume(np.linalg.norm(step) > 1e-2)
    found = tangents(curved)
    before, after = -found.about(first).normals, -found.about(second).normals
    np.testing.assert_allclose(after @ step, curved(second) - curved(first), atol=1e-9)
    np.testing.assert_allclose((after - before) @ [-step[1], step[0]], 0.0, atol=1e-9)


def test_the_rows_pass_a_little_inside_of_where_the_slopes_say():
    found = tangents(lambda u: 3.0 * u - 1.0)
    for u, share in (([0.2, -0.3], 0.01), ([-0.9, -0.8], 0.1)):  # by differences, and by a secant
        rows = found.about(np.array(u))
        np.testing.assert_allclose(rows.normals, -3.0 * np.eye(2), atol=1e-9)
        np.testing.assert_allclose(rows.offsets, -1.0 - share * (1.0 - 3.0 * np.array(u)), atol=1e-9)


@pytest.mark.parametrize(
    ("slacks", "rows", "other"),
    [
        (lambda u: np.array([-1.0 if u[0] < 0.5 else -np.inf, -1.0]), None, 0.6),
        (lambda u: np.array([0.2 - u[0], u[0] - 0.7]), 1, 0.1),  # the slopes of the second are not asked for
    ],
)
def test_secants_that_say_nothing_are_differences_again(slacks, rows, other):
    made = []
    found = tangents(slacks, made, rows)
    with np.errstate(invalid="ignore"):
        provisional = [found.about(np.array([u, 0.0])).provisional for u in (0.3, other)]
    assert len(made) == 2 and not any(provisional)
