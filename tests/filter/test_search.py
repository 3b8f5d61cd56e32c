"""The search for an admissible action, stage by stage: what each one tries, in which order, and what it refuses."""

import gymnasium as gym
import numpy as np
import pytest
from fake_constraints import LAST, Predicting, Rows, Still, decide, only, search, still_plant

import safe_wrappers as sw
from safe_wrappers.filter import engine
from safe_wrappers.filter.search import Stage

NONE = np.zeros((0, 2)), np.zeros(0)
"""No rows to keep."""
LEFT = Rows(((1.0, 0.0), 0.0))
"""The first control is at most 0."""


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
        guess=[((1.0, 0.0), 0.5)],
        tangents=lambda u: [((1.0, 0.0), 0.3)],
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


def test_an_admitted_proposal_is_executed_bit_for_bit():
    proposal = np.array([0.1, -0.2])
    decision = search(Predicting(lambda u: 1.0), LEFT, Rows(((1.0, 1.0), 1.0))).decide(proposal, LAST)
    keeps(decision, 0.0, -0.2)
    assert decision.stage is Stage.ROWS
    proposal = np.array([-0.1, -0.2])
    decision = search(Predicting(lambda u: 1.0), LEFT, Rows(((1.0, 1.0), 1.0))).decide(proposal, LAST)
    np.testing.assert_array_equal(decision.control, proposal)
    assert decision.stage is Stage.PROPOSAL and not decision.changed and decision.refused is None


def test_rows_that_a_prediction_admits_are_not_guessed_at():
    # The proposal is refused by rows alone: the guess of what predicts does not count.
    decision = decide((1.0, 0.5), LEFT, Predicting(lambda u: 1.0, guess=[((1.0, 0.0), -0.5)]))
    keeps(decision, 0.0, 0.5)
    assert decision.stage is Stage.ROWS
    # Unless the answer is refused.
    decision = decide((1.0, 0.5), LEFT, Predicting(lambda u: -0.4 - u[0], guess=[((1.0, 0.0), -0.5)]))
    keeps(decision, -0.5, 0.5)
    assert decision.stage is Stage.ROWS and decision.refused.tolist() == [True, True]


def test_what_rows_make_of_an_admitted_proposal_is_asked_about_too():
    balance = Predicting(lambda u: sum(u) - 0.5, guess=[((-1.0, -1.0), -0.5)])
    decision = decide((1.0, 0.2), LEFT, balance)  # by LEFT alone (0, 0.2)
    keeps(decision, 0.0, 0.5)
    assert decision.stage is Stage.ROWS and decision.refused.tolist() == [True, False]


def test_refused_names_those_that_do_not_admit_the_proposal():
    decision = decide(
        (1.0, 1.0), LEFT, Rows(((0.0, 1.0), 2.0)), Predicting(lambda u: 0.5 - u[1]), Predicting(sum)
    )
    assert decision.refused.tolist() == [True, False, True, False]


def test_changes_are_counted_in_shares_of_what_acts():
    # The first control saturates at 0.5: in shares of what acts it costs twice as much to change.
    decision = decide((1.0, 1.0), Rows(((1.0, 1.0), 0.5)), acting=((-0.5, -1.0), (0.5, 1.0)))
    keeps(decision, 0.3, 0.2)
    # What saturates as the proposal did stays the proposal's.
    decision = decide((1.0, 1.0), Rows(((0.0, 1.0), 0.5)), acting=((-0.5, -1.0), (0.5, 1.0)))
    keeps(decision, 1.0, 0.5)


# Candidates -------------------------------------------------------------------------------------------------------


def test_a_candidate_keeps_the_rows_and_every_prediction():
    candidates = [(0.5, 0.0), (-0.5, 0.9), (-0.2, 0.0), (-0.1, 0.0)]
    first = Predicting(lambda u: 0.8 - max(u), candidates=candidates)
    found = search(first, Predicting(lambda u: 0.5 - u[1])).candidate(
        np.ones(2), (np.array([[1.0, 0.0]]), np.zeros(1))
    )
    np.testing.assert_array_equal(found, [-0.2, 0.0])
    assert search(Predicting(only(), candidates=candidates)).candidate(np.ones(2), NONE) is None


# Linearising anew -------------------------------------------------------------------------------------------------


def creeping(slack):
    """Every linearisation asks for a step of 0.1 to the left."""
    return Predicting(slack, tangents=lambda u: [((1.0, 0.0), u[0] - 0.1)])


@pytest.mark.parametrize("steps", [1, 3, 5, 6])
def test_a_refused_control_is_linearised_up_to_six_times(steps):
    decision = decide((1.0, 0.5), creeping(lambda u: 1.0001 - 0.1 * steps - u[0]))
    keeps(decision, 1.0 - 0.1 * steps, 0.5)
    assert decision.stage is Stage.RELINEARIZED


def test_and_not_seven_times():
    found = creeping(lambda u: 0.3001 - u[0])
    admitted, control, rows = search(found).relinearize(np.ones(2), np.ones(2), NONE, NONE)
    assert not admitted and len(rows[1]) == 6
    np.testing.assert_allclose(control, [0.4, 1.0])
    assert decide((1.0, 0.5), found).infeasible


def test_tangents_that_are_no_numbers_end_it():
    # The other row is kept, and the answer would be admitted; it is not taken for the answer of a projection.
    tangents = [((np.nan, 0.0), 0.3), ((1.0, 0.0), 0.3)]
    broken = Predicting(lambda u: 0.5 - u[0], tangents=lambda u: tangents, control=(-1.0, 0.5))
    decision = decide((1.0, 0.5), broken)
    keeps(decision, 0.475, 0.5)  # towards the backup, by 5 % of the violation beyond the boundary
    assert decision.stage is Stage.BLEND


def test_provisional_tangents_give_way_to_the_next_ones():
    limits, provisional = iter([0.9, -0.5, 0.6]), iter([False, True, True])

    class Guessing(Predicting):
        def linearize(self, control):
            return sw.HalfSpaces(np.array([[1.0, 0.0]]), np.array([next(limits)]), next(provisional))

    admitted, control, rows = search(Guessing(only((0.6, 1.0)))).relinearize(
        np.ones(2), np.ones(2), NONE, NONE
    )
    assert admitted
    np.testing.assert_allclose(control, [0.6, 1.0])
    np.testing.assert_allclose(rows[1], [0.9, 0.6])


# Shortening -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("limit", [0.5, 0.0, -0.6])
def test_an_admitted_correction_is_shortened_to_what_is_needed(limit):
    found = search(Predicting(lambda u: limit - u[0])).shorten(np.ones(2), np.array([-1.0, 1.0]), NONE)
    np.testing.assert_allclose(found, [1.0 - 1.05 * (1.0 - limit), 1.0])


def test_a_fallback_that_is_admitted_is_shortened_before_it_is_executed():
    decision = decide(
        (1.0, 0.5), Predicting(lambda u: 0.5 - u[0]), fallback=lambda plant: np.array([-1.0, 0.5])
    )
    keeps(decision, 0.475, 0.5)  # by 5 % of the violation beyond the boundary
    assert decision.stage is Stage.BLEND and not decision.fallback


def test_what_is_shortened_keeps_the_rows():
    strict = np.array([[1.0, 0.0]]), np.array([-0.4])
    found = search(Predicting(lambda u: 0.5 - u[0])).shorten(np.ones(2), np.array([-1.0, 1.0]), strict)
    assert found[0] <= -0.4 and found[0] > -1.0


# Rounding ---------------------------------------------------------------------------------------------------------


def test_what_is_executed_is_what_was_judged(given):
    judged = []

    def slack(u):
        judged.append(tuple(u))
        return 1.0 / 3.0 - u[0] * u[0] - 0.1 * u[1]

    def tangents(u):
        value = slack(u)
        return [((2.0 * u[0], 0.1), value + 2.0 * u[0] * u[0] + 0.1 * u[1])]

    env = sw.CBFActionFilter(Still32(), [Fake(Predicting(slack, tangents=tangents))], plant=still_plant())
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(30):
        executed = env.step(rng.uniform(-1.0, 1.0, 2).astype(np.float32))[4]["executed_action"]
        assert tuple(executed) in judged and slack(executed) >= -1e-9
        np.testing.assert_array_equal(executed, executed.astype(np.float32))


# Rows that contradict each other ----------------------------------------------------------------------------------
# The least violation of "at most 0" and "at least 0.5" is 0.25. A prediction that asks for 0.2 would let it through.


def contradicting(at_least):
    return Predicting(lambda u: u[0] - 0.2, tangents=lambda u: [((-1.0, 0.0), -at_least())])


@pytest.mark.parametrize("before", [0, 2, 5])
def test_tangents_against_rows_let_nothing_through_that_breaks_the_rows(before):
    asked = iter([0.1] * before + [0.5] * 9)
    least = search(contradicting(lambda: next(asked)), LEFT)
    admitted, control, _ = least.relinearize(
        np.zeros(2), np.zeros(2), *[(np.array([[1.0, 0.0]]), np.zeros(1))] * 2
    )
    assert control[0] == pytest.approx(0.25, abs=0.03)
    assert not admitted
    asked = iter([0.1] * before + [0.5] * 9)
    decision = decide((0.0, 0.0), contradicting(lambda: next(asked)), LEFT, fallback="zero")
    assert decision.stage is Stage.FALLBACK and decision.infeasible and decision.fallback
    keeps(decision, 0.0, 0.0)


def test_tangents_that_contradict_each_other_are_only_guesses():
    tangents = [((1.0, 0.0), 0.0), ((-1.0, 0.0), -0.5)]
    decision = decide((1.0, 0.5), Predicting(lambda u: 0.3 - u[0], tangents=lambda u: tangents))
    assert decision.stage is Stage.RELINEARIZED and decision.control[0] == pytest.approx(0.25)


def test_a_guess_against_rows_is_dropped():
    guessing = Predicting(
        lambda u: -0.2 - u[0], guess=[((-1.0, 0.0), -0.5)], tangents=lambda u: [((1.0, 0.0), -0.3)]
    )
    decision = decide((1.0, 0.5), guessing, LEFT)
    keeps(decision, -0.3, 0.5)
    assert decision.stage is Stage.RELINEARIZED
    # Its least violation, 0.25, is not executed, even where the prediction would admit it.
    decision = decide((1.0, 0.5), Predicting(lambda u: -abs(u[0] - 0.25) + 0.1, [((-1.0, 0.0), -0.5)]), LEFT)
    assert decision.infeasible and decision.control[0] <= 1e-9


def test_a_guess_that_contradicts_itself_is_dropped_without_any_rows():
    guess = [((-1.0, 0.0), -0.5), ((1.0, 0.0), 0.0)]
    decision = decide((1.0, 0.5), Predicting(lambda u: 0.9001 - u[0], guess, lambda u: [((1.0, 0.0), 0.9)]))
    keeps(decision, 0.9, 0.5)
    assert decision.stage is Stage.RELINEARIZED


def test_rows_that_contradict_each_other_are_infeasible():
    decision = decide((0.2, 0.0), LEFT, Rows(((-1.0, 0.0), -0.5)))
    keeps(decision, 0.25, 0.0)  # nothing brakes here: what violates the rows least
    assert decision.stage is Stage.FALLBACK and decision.infeasible and decision.fallback
    # Also where a prediction refuses the proposal.
    decision = decide((0.2, 0.0), LEFT, Rows(((-1.0, 0.0), -0.5)), Predicting(lambda u: 0.1 - u[0]))
    assert decision.stage is Stage.FALLBACK and decision.infeasible and decision.fallback


def test_rows_that_are_no_numbers_are_a_failure_and_no_contradiction():
    for more in ([], [Predicting(only())]):
        decision = decide((0.2, 0.0), Rows(((np.nan, 0.0), 0.0)), *more)
        assert decision.stage is Stage.FALLBACK and decision.fallback and not decision.infeasible


# Overshoot, backup, blend, each by itself -------------------------------------------------------------------------

HALF = np.array([[1.0, 0.0]]), np.array([0.5])


@pytest.mark.parametrize(("limit", "found"), [(0.495, 0.49), (0.46, 0.45)])
def test_overshoot_adds_a_share_of_what_the_rows_took(limit, found):
    more = search(Predicting(lambda u: limit - u[0])).overshoot(np.ones(2), HALF)
    np.testing.assert_allclose(more, [found, 1.0], atol=1e-12)


def test_overshoot_gives_up():
    assert search(Predicting(lambda u: 0.44 - u[0])).overshoot(np.ones(2), HALF) is None
    assert search(Predicting(lambda u: 1.0)).overshoot(np.zeros(2), HALF) is None  # no row took anything
    rows = np.array([[1.0, 0.0], [-1.0, 0.0]]), np.array([0.5, -0.5])  # to the point: more contradicts
    assert search(Predicting(lambda u: 1.0)).overshoot(np.ones(2), rows) is None


def test_backup_is_the_first_one_that_keeps_everything():
    some = [
        Predicting(lambda u: 1.0, control=c)
        for c in ((0.5, 0.0), None, (-0.5, 0.9), (-9.0, 0.1), (-0.3, 0.0))
    ]
    found = search(*some, Predicting(lambda u: 0.5 - u[1])).backup((np.array([[1.0, 0.0]]), np.zeros(1)))
    np.testing.assert_array_equal(found, [-1.0, 0.1])  # clipped to the box
    assert search(Predicting(only(), control=(0.0, 0.0))).backup(NONE) is None


@pytest.mark.parametrize(("limit", "share"), [(0.85, 0.1), (0.6, 0.25), (0.1, 0.5), (-0.4, 0.75)])
def test_blend_moves_as_little_as_it_may(limit, share):
    found = search(Predicting(lambda u: limit - max(u))).blend(np.ones(2), -np.ones(2), NONE)
    np.testing.assert_allclose(found, 1.0 - 2.0 * share)


@pytest.mark.parametrize("component", [0, 1])
def test_blend_leaves_one_component(component):
    other = 1 - component
    found = search(Predicting(lambda u: -0.9 - u[other])).blend(np.ones(2), -np.ones(2), NONE)
    assert found[component] == 1.0 and found[other] == -1.0


# The fallback and the least violation -----------------------------------------------------------------------------


@pytest.mark.parametrize(("at", "infeasible"), [(0.0, False), (0.3, True)])
def test_a_fallback_that_is_admitted_is_not_infeasible(at, infeasible):
    decision = decide((1.0, 1.0), Predicting(only((at, at))), fallback="zero")
    keeps(decision, 0.0, 0.0)
    assert decision.stage is Stage.FALLBACK and decision.fallback and decision.infeasible == infeasible


def opposed(scale, fallback="brake"):
    """More of the first control is worse for one constraint and better for another; no control will do."""
    more = Predicting(lambda u: -10.0 * (1.0 + u[0]), guess=[((1.0, 0.0), 0.0)], scale=scale)
    return decide((1.0, 0.0), more, Predicting(lambda u: 0.5 * u[0] - 1.0), fallback=fallback)


@pytest.mark.parametrize(
    ("scale", "at"),
    [(100.0, 1.0), (1.0, -0.1)],  # the proposal; the farthest that was tried
)
def test_the_least_violation_is_judged_in_shares_of_the_scales(scale, at):
    decision = opposed(scale)
    keeps(decision, at, 0.0)
    assert decision.stage is Stage.LEAST_VIOLATION and decision.infeasible and decision.fallback


def test_the_fallback_may_violate_least_itself():
    decision = decide((1.0, 0.0), Predicting(lambda u: -1.0 - abs(u[0]), guess=[((1.0, 0.0), 0.0)]))
    keeps(decision, 0.0, 0.0)
    assert decision.stage is Stage.FALLBACK and decision.infeasible and decision.fallback


def test_a_fallback_that_was_chosen_is_executed_whatever_it_violates():
    decision = opposed(100.0, "zero")
    keeps(decision, 0.0, 0.0)
    assert decision.stage is Stage.FALLBACK and decision.infeasible


def test_the_least_violation_keeps_the_rows():
    # The proposal, tried first, violates the prediction least, and the rows.
    decision = decide((1.0, 0.0), Predicting(lambda u: u[0] - 2.0), LEFT)
    keeps(decision, 0.0, 0.0)
    assert decision.infeasible


# What the wrapper reports -----------------------------------------------------------------------------------------


class Fake(sw.Constraint):
    """A specification that becomes what it is given."""

    def __init__(self, bound):
        self.bound = bound


@pytest.fixture
def given(monkeypatch):
    """Filters take what a `Fake` is to become."""
    monkeypatch.setattr(engine, "Bound", lambda constraint, plant: constraint.bound)


class Still32(Still):
    """Its actions are rounded."""

    action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)


def reported(bound, action, **options):
    env = sw.CBFActionFilter(Still(), [Fake(bound)], plant=still_plant(), **options)
    stages = [env.reset(seed=0)[1]["cbf/stage"]]
    return [*stages, env.step(np.array(action))[4]["cbf/stage"]]


@pytest.mark.parametrize(
    ("bound", "action", "stage"),
    [
        (LEFT, (-0.5, 0.0), 0),
        (LEFT, (0.5, 0.0), 1),
        (Predicting(lambda u: -u[0], candidates=[(0.0, 0.0)]), (0.5, 0.0), 2),
        (creeping(lambda u: 0.2 - u[0]), (0.5, 0.0), 3),
        (Predicting(lambda u: 0.455 - u[0], guess=[((1.0, 0.0), 0.46)]), (1.0, 0.0), 4),
        (Predicting(lambda u: -u[0], control=(-1.0, 0.0)), (0.5, 0.0), 5),
        (Predicting(only((-1.0, -1.0)), control=(-1.0, -1.0)), (0.5, 0.5), 6),
        (Predicting(only((0.0, 0.0))), (0.5, 0.5), 7),
        (Predicting(lambda u: u[0] - 2.0), (0.5, 0.5), 8),
    ],
)
def test_info_says_which_stage_answered(given, bound, action, stage):
    options = {"fallback": "zero"} if stage == 7 else {}
    if stage == 8:  # the fallback and the proposal fail; the proposal fails less
        bound = Predicting(lambda u: u[0] - 2.0, guess=[((1.0, 0.0), 0.2)])
    assert reported(bound, action, **options) == [0, stage]


@pytest.mark.filterwarnings("ignore:the policy's action is not finite")
def test_the_fallback_answers_where_nothing_was_proposed(given):
    assert reported(LEFT, (np.nan, 0.0)) == [0, int(Stage.FALLBACK)]


def test_a_fallback_in_place_of_a_proposal_is_filtered_like_one():
    found = search(LEFT, fallback=lambda plant: np.array([0.7, 0.3]))
    decision = found.without_proposal(LAST)
    keeps(decision, 0.0, 0.3)
    assert decision.stage is Stage.FALLBACK and decision.fallback and decision.changed
    assert decision.refused is None and not decision.infeasible
    # A state that is not a number says nothing about any control: then it is not.
    keeps(found.unreadable(LAST), 0.7, 0.3)
