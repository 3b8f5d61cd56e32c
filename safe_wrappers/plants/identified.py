"""IdentifiedPlant: dynamics fitted to logged steps, with errors measured on other episodes.

Source of the bounds: Vovk, Gammerman and Shafer, *Algorithmic Learning in a Random World*, 2005 (split conformal
prediction); the finite-sample rank as in Lei et al., *Distribution-Free Predictive Inference for Regression*, JASA
2018.
"""

import copy
import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike

from safe_wrappers import info as keys
from safe_wrappers.errors import (
    Array,
    ConfigurationError,
    UnsupportedEnvError,
    finite_array,
    positive,
    whole_number,
)
from safe_wrappers.plants.env_checks import name_of, refuse_changed_actions
from safe_wrappers.plants.simulator import Measure, Rollout, RolloutPlant, View

_LEAST_SCALE = 1e-3  # of the largest one
_ROUNDING = 1e-9  # (9 + 1) * 0.1 is a whole number, and so is what its rounding makes of it


class Episode(NamedTuple):
    """One logged episode of T steps: observations, shape (T + 1, n), and actions, shape (T, m)."""

    observations: Array
    actions: Array


def log_steps(
    env: gym.Env[Any, Any],
    policy: Callable[[Any], Any] | None = None,
    episodes: int = 100,
    seed: int = 0,
    max_steps: int = 1000,
) -> list[Episode]:
    """Drive an env and log it.

    Logged is the executed action, where a filter inside reports one, else the policy's.

    Args:
        env: With observations of shape (n,).
        policy: Takes an observation, returns an action; None draws actions from the action space.
        episodes: How many.
        seed: Of the first reset, and of drawn actions. The other resets go on with the env's generator.
        max_steps: An episode that has not ended by then is cut off.

    Raises:
        ConfigurationError: Observations of another kind, or counts that are no whole numbers.
    """
    episodes = whole_number("episodes", episodes, 1, "episodes")
    max_steps = whole_number("max_steps", max_steps, 1, "steps")
    space = copy.deepcopy(env.action_space)  # the env's own generator stays as it was
    space.seed(seed)
    found: list[tuple[Any, Any]] = []
    for index in range(episodes):
        # Copies: some envs return the same array again, changed.
        observations, actions = [copy.copy(env.reset(seed=None if index else seed)[0])], []
        for _ in range(max_steps):
            action = space.sample() if policy is None else policy(observations[-1])
            observation, _, terminated, truncated, info = env.step(action)
            observations.append(copy.copy(observation))
            actions.append(np.atleast_1d(info.get(keys.EXECUTED_ACTION, action)))
            if terminated or truncated:
                break
        found.append((observations, actions))
    return checked_episodes(found)


def checked_episodes(given: Sequence[tuple[ArrayLike, ArrayLike]]) -> list[Episode]:
    """The episodes as arrays of float64 of one width.

    Raises:
        ConfigurationError: Other shapes, or numbers that are not finite; the message says in which episode.
    """
    if not isinstance(given, list | tuple) or not given:
        raise ConfigurationError(
            f"episodes is a list of (observations, actions), as log_steps returns it; got {given!r}"
        )
    found: list[Episode] = []
    for index, one in enumerate(given):
        if not isinstance(one, list | tuple) or len(one) != 2:
            raise ConfigurationError(f"episode {index} is no pair (observations, actions): {one!r}")
        names = (f"{part} of episode {index}" for part in Episode._fields)
        episode = Episode(*map(finite_array, names, one))
        found.append(episode)
        widths, wanted = ([part.shape[1:] for part in some] for some in (episode, found[0]))
        steps = len(episode.actions)
        plain = all(part.ndim == 2 for part in episode) and widths == wanted
        if not plain or len(episode.observations) != steps + 1 or not steps:
            raise ConfigurationError(
                f"episode {index}: expected observations of shape (T + 1, n) and actions of shape (T, m) with T of at"
                f" least 1, and n and m as in episode 0, got {episode.observations.shape} and {episode.actions.shape}"
            )
    return found


def fitted(episodes: Sequence[Episode]) -> Array:
    """Weights W, shape (n + m + 1, n), of `x+ = x + [x, u, 1] @ W`, by least squares; the smallest that fit best."""
    inputs = np.concatenate([np.hstack([o[:-1], a, np.ones((len(a), 1))]) for o, a in episodes])
    if len(inputs) < inputs.shape[1]:
        raise ConfigurationError(
            f"{len(inputs)} steps are left for the fit of {inputs.shape[1]} numbers per observation: give more "
            "episodes"
        )
    changes = np.concatenate([np.diff(one.observations, axis=0) for one in episodes])
    return np.asarray(np.linalg.lstsq(inputs, changes, rcond=None)[0], dtype=np.float64)


def allowed_misses(scores: int, miss_rate: float) -> int:
    """How many of n scores, and the next one, may be above the bound: (n + 1) miss_rate, rounded down."""
    return math.floor((scores + 1) * miss_rate + _ROUNDING)


def upper_bound(scores: Array, miss_rate: float) -> float:
    """What the next score exceeds with a probability of at most `miss_rate`.

    It is the ceil((n + 1)(1 - miss_rate))-th smallest of the scores, shape (n,), which are exchangeable with the next
    one; NaN counts as infinite. It is infinite where no score may be above, or too many are infinite.
    """
    rank = len(scores) + 1 - allowed_misses(len(scores), miss_rate)
    if rank > len(scores):
        return math.inf
    return float(np.sort(np.where(np.isnan(scores), np.inf, scores))[rank - 1])


class IdentifiedPlant(RolloutPlant):
    """Rolls out a model `x+ = F(x, u)` that was fitted to logged episodes; x is the observation.

    Some episodes are held out of the fit. From their prediction errors come `margins`, by split conformal
    prediction: **in a new episode that is drawn as the logged ones were, by the same policy in the same env, a window
    anywhere in it has a true measure below its prediction less the margins, at any of its steps, with a probability
    of at most `miss_rate`.** The model may be wrong and the noise of any kind; only the margins get wider.

    **What this is not**: a guarantee in closed loop. The filter changes which actions are executed and which states
    are visited, and it prefers actions that the model takes for good, whether or not they are. So coverage is
    monitored: at every step the next measure is predicted, less the margin of a first step, and `plant/coverage` is
    the share of the episode's steps whose prediction held.

    Args:
        episodes: Pairs (observations, shape (T + 1, n); actions, shape (T, m)), as `log_steps` returns them; drawn
            independently of each other.
        miss_rate: See above, between 0 and 1.
        seed: Of the draw of those that are held out, half of them, and of windows in the episodes.
        control_dt: Control interval, s; None takes the env's `dt`. An env without `dt` has none, and wrappers that
            count in seconds ask for it.

    Info, at every step: ``plant/coverage``.

    Attributes:
        fit_episodes: Those that it was fitted to.
        held_out_episodes: Those that margins come from.

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

    def __init__(
        self,
        episodes: Sequence[tuple[ArrayLike, ArrayLike]],
        miss_rate: float = 0.1,
        seed: int = 0,
        control_dt: float | None = None,
    ) -> None:
        self.miss_rate = positive("miss_rate", miss_rate, "shares of 1")
        if self.miss_rate >= 1.0:
            raise ConfigurationError(f"miss_rate is between 0 and 1, got {miss_rate!r}")
        super().__init__(control_dt)
        every = checked_episodes(episodes)
        calibrating = len(every) // 2
        if not allowed_misses(calibrating, self.miss_rate):
            fewest = 2 * math.ceil(1.0 / self.miss_rate - 1.0 - _ROUNDING)
            raise ConfigurationError(
                f"miss_rate = {self.miss_rate:g} needs at least {fewest} episodes, half of which are held out of the "
                f"fit, got {len(every)}: give more, or allow a larger miss_rate"
            )
        draw = np.random.default_rng(whole_number("seed", seed, 0))
        order, places = draw.permutation(len(every)), draw.random(len(every))
        self.held_out_episodes = [every[i] for i in order[:calibrating]]
        self.fit_episodes = [every[i] for i in order[calibrating:]]
        # One window per episode: windows of one episode are alike, and no further independent scores.
        self._places, self._scale_places = places[:calibrating], places[calibrating:]
        self._weights = fitted(self.fit_episodes)
        self._watched: Measure | None = None
        self._judged = self._missed = 0
        self._least: float | None = None  # of the watched measure after the step under way

    def model(self, states: Array, controls: Array) -> Array:
        """The fitted states after a step, shape (..., n), from states, (..., n), and controls, (..., m)."""
        n = states.shape[-1]
        weights = self._weights
        return np.asarray(states + states @ weights[:n] + controls @ weights[n:-1] + weights[-1])

    def bind(self, env: gym.Env[Any, Any]) -> None:
        refuse_changed_actions(env)
        widths = [part.shape[1:] for part in self.fit_episodes[0]]
        shapes = env.observation_space.shape, env.action_space.shape or (1,)
        for name, space, have in zip(Episode._fields, shapes, widths, strict=True):
            if space != have:
                raise UnsupportedEnvError(
                    f"the model was fitted to {name} of shape {have}, {name_of(env)} has {space}; log episodes "
                    "of this env, with the wrappers that are inside the filter (such as FlattenObservation)"
                )
        super().bind(env)
        self.view = View(None, np.zeros(widths[0]), {})

    @property
    def state(self) -> Array:
        return np.asarray(self.view.observation, dtype=np.float64)

    def received(self, observation: Any, info: dict[str, Any]) -> None:
        """Take what the env's reset or step has returned, and judge the prediction of it."""
        self.view = View(None, observation, info)
        if self._least is not None:
            assert self._watched is not None
            self._judged += 1
            self._missed += not self._watched(self.view) >= self._least
            self._least = None

    def executed(self, control: Array | None) -> None:
        """Predict the watched measure after a step, with its margin; None: a new episode."""
        self._least = None
        if control is None:
            self._judged = self._missed = 0
        elif self._watched is not None and np.isfinite(self.state).all():
            predicted = self.model(self.state, control)
            self._least = self._watched(View(None, predicted, {})) - self._first

    def run(self, task: Callable[[Any], Rollout]) -> Rollout:
        return task(_Stepped(self))

    def margins(self, measure: Measure, horizon: int) -> Array:
        """By how much a measure may be worse than predicted after each step, shape (horizon,), in its unit.

        The steps share one miss rate: all margins of a window hold with a probability of at least 1 - `miss_rate`.
        They are proportional to the errors of the steps in the episodes that the model was fitted to. From now on
        coverage is monitored for this measure.

        Raises:
            ConfigurationError: Too many rollouts of held-out episodes give no number.
        """
        fitted = self._shortfalls(self.fit_episodes, self._scale_places, horizon, measure)
        # Any scales do, if they are fixed before the scores are looked at.
        scales = np.sqrt(np.square(np.where(np.isfinite(fitted), fitted, 0.0)).mean(axis=0))
        scales = np.maximum(scales, _LEAST_SCALE * (scales.max() or 1.0))
        held_out = self._shortfalls(self.held_out_episodes, self._places, horizon, measure)
        factor = upper_bound((held_out / scales).max(axis=1), self.miss_rate)
        if not math.isfinite(factor):
            raise ConfigurationError(
                f"more than {self.miss_rate:g} of the rollouts over {horizon} steps give no finite h: the model "
                "diverges, or h is not a number there. Take a shorter horizon or more episodes"
            )
        margins: Array = max(factor, 0.0) * scales
        self._watched, self._first, self._least = measure, float(margins[0]), None
        return margins

    def _shortfalls(self, episodes: list[Episode], places: Array, horizon: int, measure: Measure) -> Array:
        """Predicted minus true measure after each step of one window of each episode, shape (episodes, horizon).

        Within it the model is rolled out from the first true observation with the logged actions, and sees no other
        observation. A place in [0, 1) goes from the first to the last window; in an episode shorter than the horizon
        the window is the whole episode. It is inf where a measure is not a number, -inf after the episode's end.
        """
        found = np.full((len(episodes), horizon), -np.inf)
        for falls, (observations, actions), place in zip(found, episodes, places, strict=True):
            start = int(place * (max(len(actions) - horizon, 0) + 1))
            state = observations[start]
            for step, control in enumerate(actions[start : start + horizon]):
                with np.errstate(over="ignore", invalid="ignore"):  # a bad model may diverge: measured here
                    state = self.model(state, control)
                true, predicted = (
                    measure(View(None, x, {})) for x in (observations[start + step + 1], state)
                )
                fall = predicted - true if predicted != true else 0.0  # infinite ones, too
                falls[step] = np.inf if np.isnan(fall) else fall
        return found

    def info(self) -> dict[str, Any]:
        share = 1.0 - self._missed / self._judged if self._judged else keys.NOT_JUDGED
        return {keys.PLANT_COVERAGE: share}


class _Stepped:
    """Stands for the env in a rollout: it steps the model, which knows neither rewards nor ends."""

    unwrapped = None

    def __init__(self, plant: IdentifiedPlant) -> None:
        self._plant, self._state = plant, plant.state

    def step(self, action: Any) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        self._state = self._plant.model(self._state, self._plant.control(action, "the policy"))
        return self._state, math.nan, False, False, {}
