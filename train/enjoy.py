"""A trained policy to look at: `safe-wrappers enjoy RUN`."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any, Literal

import gymnasium as gym
from rich.console import Console

from safe_wrappers import info as keys
from safe_wrappers.errors import ConfigurationError

from .atomic import write_bytes
from .evaluation.step_log import is_violation
from .policies import load_policy
from .run.policy import TrainedPolicy
from .videos.film import Film, encode, for_film, speed_of, stride_of

FilterName = Literal["trained", "none", "protect"]


def enjoy_command(
    run: str,
    episodes: int,
    action_filter: FilterName,
    window: bool,
    film: Path | None,
    console: Console,
    imports: Collection[str] = (),
) -> None:
    """Lets a run's policy act, and prints a line per episode.

    Args:
        run: As `load_policy` takes it.
        episodes: How many; their env seeds are 0, 1, 2, ...
        action_filter: The filter that it was trained with, or another.
        window: The task draws itself in a window.
        film: Where to write a film of the first episode (WebP).
        console: Where to print.
        imports: As `load_policy` takes it.

    Raises:
        ConfigurationError: No such run, or the task cannot be drawn in this way.
    """
    trained = load_policy(run, other_filter=action_filter != "trained", imports=imports)
    env = _drawn(trained, action_filter, "human" if window else "rgb_array" if film is not None else None)
    try:
        for seed in range(episodes):
            taken = _Film(env) if film is not None and seed == 0 else None
            console.print(_episode(trained, env, seed, taken), highlight=False, soft_wrap=True)
            if taken is not None and film is not None:
                write_bytes(film, taken.encoded())
                console.print(f"Film: {film}", highlight=False, soft_wrap=True)
    finally:
        env.close()


def _drawn(trained: TrainedPolicy, action_filter: FilterName, render_mode: str | None) -> gym.Env[Any, Any]:
    env = trained.make_env(action_filter)
    modes = env.unwrapped.metadata.get("render_modes") or []
    if render_mode is None:
        return env
    env.close()
    if render_mode not in modes:
        wanted, other = ("window", "--output FILM.webp") if render_mode == "human" else ("frames", "--render")
        raise ConfigurationError(
            f"{trained.arm.env.id} draws no {wanted} (its render modes: {', '.join(modes) or 'none'}); try {other},"
            " or leave it out"
        )
    env = trained.make_env(action_filter, render_mode)
    return for_film(env) if render_mode == "rgb_array" else env


def _episode(trained: TrainedPolicy, env: gym.Env[Any, Any], seed: int, film: _Film | None) -> str:
    """Runs an episode; returns what is to be said of it."""
    observation, _ = env.reset(seed=seed)
    trained.begin(env)
    done = False
    while not done:
        if film is not None:
            film.before()
        observation, _, terminated, truncated, info = env.step(trained(observation))
        if film is not None:
            film.after(info)
        done = terminated or truncated
    figures = info[keys.EPISODE_SUMMARY]
    words = [f"return {figures['return']:.2f}", f"{figures['length']} steps"]
    if "violations" in figures:
        words.append(f"{figures['violations']} in violation")
    if "intervention_rate" in figures:
        words.append(f"{100 * figures['intervention_rate']:.1f} % changed")
    return f"episode {seed}: {', '.join(words)}"


class _Film:
    """Frames of one episode, and the strip below that shows when the filter acted."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self._env = env
        self._longest = env.spec.max_episode_steps if env.spec is not None else None
        self._film = Film(stride=stride_of(self._longest or 1))

    def before(self) -> None:
        if self._film.wants_frame:
            self._film.add_frame(self._env.render())  # type: ignore[arg-type]

    def after(self, info: dict[str, Any]) -> None:
        self._film.add_step(bool(info.get(keys.CBF_INTERVENED, False)), is_violation(info))

    def encoded(self) -> bytes:
        fps = float(self._env.metadata.get("render_fps") or 30.0)
        return encode(self._film, fps, speed_of(self._longest or len(self._film.changed), fps))
