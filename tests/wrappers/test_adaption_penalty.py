import numpy as np
import pytest
from worlds import Cart, SpeedRow, cart_plant

import safe_wrappers as sw
from safe_wrappers import info as keys

LIMIT = 0.25
"""The cart may not be faster; from rest at full throttle it gets there in 2.5 steps of 0.1 s."""


class PaidCart(Cart):
    """A cart that is paid its position, ten times over, less what its push costs."""

    def step(self, action):
        observation, _, terminated, truncated, info = super().step(action)
        reward = 10.0 * self.state[0] - float(np.asarray(action)[0]) ** 2
        return observation, reward, terminated, truncated, info


def filtered(env=None):
    return sw.CBFActionFilter(env or PaidCart(), [SpeedRow(LIMIT)], plant=cart_plant())


def drive(env, steps=40, seed=0):
    """Random pushes from rest: each push, the speed before it, and what the step returned."""
    rng = np.random.default_rng(seed)
    speed, seen = env.reset(seed=seed)[0][1], []
    for push in rng.uniform(-0.2, 1.0, (steps, 1)).astype(np.float32):
        step = env.step(push)
        seen.append((push, speed, *step))
        speed = step[0][1]
    return seen


@pytest.mark.parametrize(
    ("penalty", "per_correction", "per_squared", "bounded", "scale"),
    [
        (0.5, 0.0, 0.0, 0.0, 1.0),
        (0.0, 2.0, 0.0, 0.0, 1.0),
        (0.5, 2.0, 0.0, 0.0, 1.0),
        (np.float32(3), 0, 0, 0, 1),
        (0.0, 0.0, 4.0, 0.0, 1.0),
        (0.0, 0.0, 0.0, 0.5, 1.0),
        (0.0, 0.0, 0.0, 0.5, 0.2),
        (0.5, 2.0, 4.0, 0.5, 0.2),
    ],
)
def test_a_changed_step_costs_what_the_formula_says_and_no_other(
    penalty, per_correction, per_squared, bounded, scale
):
    given = penalty, per_correction, per_squared, bounded, scale
    penalised, plain = drive(sw.AdaptionPenalty(filtered(), *given)), drive(filtered())
    changed = 0
    for (push, speed, observation, reward, *_, info), (_, _, same, task, *_) in zip(
        penalised, plain, strict=True
    ):
        # The filter in closed form: no push above the one that reaches the limit within this step.
        correction = float(push[0]) - min(float(push[0]), (LIMIT - speed) / 0.1)
        bend = 1.0 - np.exp(-((correction / scale) ** 2))
        cost = penalty + per_correction * correction + per_squared * correction**2 + bounded * bend
        expected = cost if correction > 0 else 0.0
        changed += correction > 0
        assert info[keys.ADAPTION_PENALTY] == pytest.approx(expected, abs=1e-6)
        assert info[keys.ADAPTION_TASK_REWARD] == task
        assert reward == task - info[keys.ADAPTION_PENALTY]
        assert type(info[keys.ADAPTION_PENALTY]) is type(info[keys.ADAPTION_TASK_REWARD]) is float
        np.testing.assert_array_equal(observation, same)
    assert 5 < changed < 35


def test_a_non_finite_action_costs_the_constant_and_a_finite_amount():
    env = sw.AdaptionPenalty(filtered(), penalty=0.5, per_correction=2.0)
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="not finite"):
        _, reward, _, _, info = env.step(np.array([np.nan], np.float32))
    assert info[keys.CBF_INTERVENED] and info[keys.CBF_NONFINITE]
    assert info[keys.ADAPTION_PENALTY] == 0.5 + 2.0 * info[keys.CBF_CORRECTION]
    assert np.isfinite(reward)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: sw.AdaptionPenalty(PaidCart(), 1.0), "needs a CBFActionFilter inside"),
        (lambda: sw.AdaptionPenalty(sw.RecordInterventions(PaidCart()), 1.0), "needs a CBFActionFilter"),
        (
            lambda: sw.AdaptionPenalty(sw.RecordInterventions(sw.AdaptionPenalty(filtered(), 1.0)), 1.0),
            "has an AdaptionPenalty already",
        ),
        (
            lambda: sw.AdaptionPenalty(filtered()),
            "give penalty .*, per_correction .*, per_squared .*, bounded .*, or several",
        ),
        (lambda: sw.AdaptionPenalty(filtered(), 1.0, scale=0.5), "scale = 0.5 says .* give bounded"),
        (lambda: sw.AdaptionPenalty(filtered(), bounded=1.0, scale=0.0), "scale must be a finite number > 0"),
        (lambda: sw.AdaptionPenalty(filtered(), per_squared=-1.0), "per_squared must be a finite number"),
        (lambda: sw.AdaptionPenalty(filtered(), bounded=np.inf), "bounded must be a finite number >= 0"),
        (lambda: sw.AdaptionPenalty(filtered(), -1.0), "penalty must be a finite number >= 0"),
        (lambda: sw.AdaptionPenalty(filtered(), np.nan), "penalty must be a finite number >= 0"),
        (lambda: sw.AdaptionPenalty(filtered(), 1.0, np.inf), "per_correction must be a finite number >= 0"),
        (lambda: sw.AdaptionPenalty(filtered(), "much"), "penalty must be a number in the task's reward"),
    ],
)
def test_what_it_refuses(build, message):
    with pytest.raises(sw.SafeWrappersError, match=message):
        build()
