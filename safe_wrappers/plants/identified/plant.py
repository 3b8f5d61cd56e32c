"""IdentifiedPlant: dynamics fitted to logged steps, with errors measured on other episodes."""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

from safe_wrappers import info as keys
from safe_wrappers.checks import Array, positive, whole_number
from safe_wrappers.errors import ConfigurationError, UnknownNameError, UnsupportedEnvError
from safe_wrappers.plants.env_checks import (
    name_of,
    refuse_changed_actions,
)
from safe_wrappers.plants.identified.coverage import Coverage, scores_needed, upper_bound
from safe_wrappers.plants.identified.logs import Episode, Model, checked_episodes, measured, shortfalls
from safe_wrappers.plants.identified.models import EnsembleModel, LinearModel
from safe_wrappers.plants.rollouts import Measure, Policy, Rollout, RolloutPlant, View
from safe_wrappers.plants.simulator.plant import known_substeps

MODELS = ("linear", "ensemble")
_SCALE_WINDOWS = 8  # per fitted episode
_LEAST_SCALE = 1e-3  # of the largest one


class IdentifiedPlant(RolloutPlant):
    """Rolls out a model `x+ = F(x, u)` that was fitted to logged episodes; x is the observation.

    Some episodes are held out of the fit. From their prediction errors come `margins`, by split conformal
    prediction: **in a new episode that is drawn as the logged ones were, by the same policy in the same env, a window
    anywhere in it has a true measure below its prediction less the margins, at any of its steps, with a probability
    of at most `miss_rate`.** The model may be wrong and the noise of any kind; only the margins get wider.

    **What this is not**: a guarantee in closed loop. The filter changes which actions are executed and which states
    are visited, and it prefers actions that the model takes for good, whether or not they are. So coverage is
    monitored: at every step the next measure is predicted, with a margin for one step of the same miss rate. If the
    misses of an episode are more than that rate explains, `plant/coverage_lost` is True until it ends.

    Args:
        episodes: Pairs (observations, shape (T + 1, n); actions, shape (T, m)), as `log_steps` returns them; drawn
            independently of each other.
        model: "linear": affine in x and u, by least squares. "ensemble": the mean of five small neural networks
            (needs torch, once, for the fit).
        miss_rate: See above, between 0 and 1.
        held_out: Share of the episodes that the model is not fitted to, drawn at random.
        seed: Of that draw, of windows in the episodes, and of the ensemble.
        control_dt: Control interval, s; None takes the env's `dt`. An env without `dt` has none, and wrappers that
            count in seconds ask for it.

    Info, at every step: ``plant/coverage``, ``plant/coverage_lost``.

    Attributes:
        model: The fitted one, a function of states, shape (k, n), and controls, shape (k, m).
        fit_episodes: Those that it was fitted to.
        held_out_episodes: Those that margins come from.
        coverage: What `plant/coverage` and `plant/coverage_lost` report.

    Raises:
        ConfigurationError: Too few episodes, or unlike ones, or numbers that are not finite.
        UnsupportedEnvError: At binding: observations or actions that are not those of the episodes.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> env = gym.make("Pendulum-v1")
        >>> plant = sw.IdentifiedPlant(sw.plants.log_steps(env, episodes=20))
        >>> slow = sw.constraints.PredictiveShield(lambda x: 7.0 - abs(x[2]), horizon=5)  # rad/s
        >>> env = sw.CBFActionFilter(env, [slow], plant=plant)
    """

    simulates_env: ClassVar[bool] = False
    info_keys = (keys.PLANT_COVERAGE, keys.PLANT_COVERAGE_LOST)

    def __init__(
        self,
        episodes: Sequence[tuple[ArrayLike, ArrayLike]],
        model: str = "linear",
        miss_rate: float = 0.1,
        held_out: float = 0.5,
        seed: int = 0,
        control_dt: float | None = None,
    ) -> None:
        if model not in MODELS:
            raise UnknownNameError(f"model is one of {', '.join(MODELS)}; got {model!r}")
        self.miss_rate = _share("miss_rate", miss_rate)
        held_out, seed = _share("held_out", held_out), whole_number("seed", seed, 0)
        super().__init__(control_dt)
        every = checked_episodes(episodes)
        calibrating = round(held_out * len(every))
        needed = scores_needed(self.miss_rate)
        if calibrating < needed or calibrating == len(every):
            fewest = next(n for n in itertools.count(needed + 1) if needed <= round(held_out * n) < n)
            raise ConfigurationError(
                f"miss_rate = {self.miss_rate:g} needs at least {needed} held-out episodes, and the fit at least one "
                f"more; of {len(every)} episodes held_out = {held_out:g} keeps {calibrating}: give {fewest} or more "
                "episodes, or allow a larger miss_rate"
            )
        draw = np.random.default_rng(seed)
        order = draw.permutation(len(every))
        self.held_out_episodes = [every[i] for i in order[:calibrating]]
        self.fit_episodes = [every[i] for i in order[calibrating:]]
        # One window per held-out episode: windows of one episode are alike, and no further independent scores.
        self._places = draw.random(calibrating)
        # Any windows do for the scales, which are only to be fixed before the scores are looked at.
        self._scale_episodes = [one for one in self.fit_episodes for _ in range(_SCALE_WINDOWS)]
        self._scale_places = draw.random(len(self._scale_episodes))
        states = np.concatenate([one.observations[:-1] for one in self.fit_episodes])
        changes = np.concatenate([np.diff(one.observations, axis=0) for one in self.fit_episodes])
        controls = np.concatenate([one.actions for one in self.fit_episodes])
        unknowns = states.shape[1] + controls.shape[1] + 1
        if len(states) < unknowns:
            raise ConfigurationError(
                f"{len(states)} steps are left for the fit of {unknowns} numbers per observation: give more episodes"
            )
        self.model: Model = (
            LinearModel(states, controls, changes)
            if model == "linear"
            else EnsembleModel(states, controls, changes, seed)
        )
        self._watched: Measure | None = None
        self.coverage = Coverage(calibrating, self.miss_rate)
        self._least: float | None = None  # of the watched measure after the step under way

    def bind(self, env: gym.Env[Any, Any]) -> None:
        """Attach to an env whose observations and actions are those of the episodes."""
        refuse_changed_actions(env)
        self._take_space(env.action_space)
        first = self.fit_episodes[0]
        for name, space, have in (
            ("observations", env.observation_space.shape, first.observations.shape[1:]),
            ("actions", self.lower.shape, first.actions.shape[1:]),
        ):
            if space != have:
                raise UnsupportedEnvError(
                    f"the model was fitted to {name} of shape {have}, {name_of(env)} has {space}; log episodes "
                    "of this env, with the wrappers that are inside the filter (such as FlattenObservation)"
                )
        self._attach(env)
        self.substeps = known_substeps(env.unwrapped)
        self.view = View(None, np.zeros(first.observations.shape[1]), {})

    @property
    def state(self) -> Array:
        """The last observation, shape (n,)."""
        return np.asarray(self.view.observation, dtype=np.float64)

    def observe(self) -> None:
        """The state is what was received last."""
        self.observation_id += 1

    def received(self, observation: Any, info: dict[str, Any]) -> None:
        """Take what the env's reset or step has returned, and judge the prediction of it."""
        self.view = View(None, observation, info)
        if self._least is not None:
            assert self._watched is not None
            self.coverage.judge(measured(self._watched, observation) >= self._least)
            self._least = None

    def executed(self, control: Array | None) -> None:
        """Predict the watched measure after a step, with its margin; None: a new episode."""
        self._least = None
        if control is None:
            self.coverage.start()
        elif self._watched is not None and np.isfinite(self.state).all():
            predicted = self.model(self.state[None], control[None])[0]
            self._least = measured(self._watched, predicted) - self._one_step

    def rollout(
        self,
        control: Array,
        horizon: int,
        policy: Policy | None = None,
        measure: Measure | None = None,
        least: float = -np.inf,
        until: Callable[[View], bool] | None = None,
        between: str = "",
    ) -> Rollout:
        """Roll out the model from the last observation: see `RolloutPlant.rollout`.

        Rewards are NaN, and no episode ends: the model knows neither.
        """
        found, state = Rollout(), self.state
        for step in range(horizon):
            state = self.model(state[None], control[None])[0]
            view = View(None, state, {})
            found.observations.append(state)
            found.rewards.append(math.nan)
            if measure is not None:
                found.values.append(measure(view))
                if not found.values[-1] >= least:
                    break
            found.reached = until is not None and until(view)
            if found.reached:
                break
            if policy is not None and step + 1 < horizon:
                control = self.control(policy(view), "the policy")
        return found

    def margins(self, measure: Measure, horizon: int) -> Array:
        """By how much a measure may be worse than predicted after each step, shape (horizon,), in its unit.

        The steps share one miss rate: all margins of a window hold with a probability of at least 1 - `miss_rate`.
        They are proportional to the errors of the steps in the episodes that the model was fitted to. From now on
        coverage is monitored for this measure.

        Raises:
            ConfigurationError: Too many rollouts of held-out episodes give no number.
        """
        found = self._margins(measure, horizon)
        self._watched, self._least = measure, None
        self._one_step = float(self._margins(measure, 1)[0])
        self.coverage.set_alarm([self.held(one, measure) for one in self.held_out_episodes])
        return found

    def held(self, episode: Episode, measure: Measure) -> NDArray[np.bool_]:
        """Whether a measure kept what `margins` says of one step, after each step of an episode, shape (T,)."""
        predicted = self.model(episode.observations[:-1], episode.actions)
        pairs = zip(predicted, episode.observations[1:], strict=True)
        return np.array([measured(measure, x) >= measured(measure, p) - self._one_step for p, x in pairs])

    def _margins(self, measure: Measure, horizon: int) -> Array:
        fitted = shortfalls(self.model, self._scale_episodes, self._scale_places, horizon, measure)
        scales = np.array([_size(column[np.isfinite(column)]) for column in fitted.T])
        largest = scales.max()
        scales = np.maximum(scales, _LEAST_SCALE * largest) if largest > 0.0 else np.ones(horizon)
        held_out = shortfalls(self.model, self.held_out_episodes, self._places, horizon, measure)
        factor = upper_bound((held_out / scales).max(axis=1), self.miss_rate)
        if not math.isfinite(factor):
            raise ConfigurationError(
                f"more than {self.miss_rate:g} of the rollouts over {horizon} steps give no finite h: the model "
                "diverges, or h is not a number there. Take a shorter horizon, more episodes, or the other model"
            )
        return max(factor, 0.0) * scales

    def info(self) -> dict[str, Any]:
        """The info keys `plant/...` of the episode so far."""
        counted = self.coverage
        share = 1.0 - counted.missed / counted.judged if counted.judged else keys.NOT_JUDGED
        return {keys.PLANT_COVERAGE: share, keys.PLANT_COVERAGE_LOST: counted.lost}


def _size(errors: Array) -> float:
    """Root of the mean square, 0 of none."""
    return float(np.sqrt((errors**2).mean())) if len(errors) else 0.0


def _share(name: str, value: float) -> float:
    share = positive(name, value, "shares of 1")
    if share >= 1.0:
        raise ConfigurationError(f"{name} is between 0 and 1, got {value!r}")
    return share
