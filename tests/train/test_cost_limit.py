"""An arm's limit on cost: its own price in training, beside any filter, and refused where it would change nothing."""

import pytest
from stable_baselines3.common.callbacks import BaseCallback

from safe_wrappers.errors import ConfigurationError
from safe_wrappers.train.run import Progress, train_run, training

LIMIT = "arms.unfiltered.learner={cost_limit: 0, multiplier_rate: 0.01}"


class Prices(BaseCallback):
    """The model's multiplier at every step."""

    seen: dict[int, float] = {}  # noqa: RUF012

    def _on_step(self):
        self.seen[self.num_timesteps] = getattr(self.model, "lagrangian_multiplier", 0.0)
        return True


@pytest.fixture
def prices(monkeypatch):
    monkeypatch.setattr(Prices, "seen", {})
    made = training.learner_callbacks
    monkeypatch.setattr(training, "learner_callbacks", lambda arm: [*made(arm), Prices()])
    return Prices.seen


def run(experiment, arm):
    train_run(arm, 0, experiment.run_folder(arm, 0), Progress(lambda _: None, lambda _: None))


def test_the_price_rises_in_the_arm_that_has_a_limit_and_in_no_other(fake_experiment, prices):
    experiment = fake_experiment(LIMIT)
    limited, filtered = experiment.arms
    run(experiment, limited)
    assert max(prices.values()) > 0.0
    prices.clear()
    run(experiment, filtered)
    assert set(prices.values()) == {0.0}


def test_a_run_that_goes_on_has_the_price_of_the_place_where_it_stands(fake_experiment, prices):
    run(short := fake_experiment(LIMIT), short.arms[0])
    stood = prices[max(prices)]
    prices.clear()
    run(longer := fake_experiment(LIMIT, "total_steps=1024"), longer.arms[0])
    assert stood > 0.0 and prices[min(prices)] == stood


def test_a_limit_needs_no_filter_and_may_stand_beside_one(fake_experiment):
    both = "arms.filtered.learner={kind: adaption_penalty, penalty: 0.1, cost_limit: 0}"
    limited, filtered = fake_experiment(LIMIT, both).arms
    assert limited.learner.cost_limit == 0.0 and filtered.learner.cost_limit == 0.0
    assert limited.fingerprint()["learner"]["multiplier_rate"] == 0.01


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["arms.unfiltered.learner={cost_limit: -1}"], "cost_limit"),
        (["arms.unfiltered.learner={multiplier_rate: 0.1}"], "belongs to cost_limit"),
        (["arms.unfiltered={filter: none, algorithm: SAC, learner: {cost_limit: 1}}"], "leave normalize out"),
        (
            [
                "arms.unfiltered={filter: none, algorithm: SAC, normalize: {observation: false},"
                " learner: {cost_limit: 1}, hyperparameters: {replay_buffer_class: HerReplayBuffer}}"
            ],
            "hindsight",
        ),
        (["arms.filtered.filter={protect: {}, escape: {value: critic}}"], "value"),
    ],
)
def test_a_limit_that_would_change_nothing_is_refused(fake_experiment, given, words):
    with pytest.raises(ConfigurationError, match=words):
        fake_experiment(*given)
