"""Trained policies at work: `safe-wrappers enjoy RUN` looks at one, `diagnose ENV` at what goes wrong."""

from __future__ import annotations

from collections.abc import Callable, Collection
from contextlib import closing
from pathlib import Path
from typing import Any, Literal

import gymnasium as gym
from rich.console import Console
from stable_baselines3.common.monitor import Monitor

from safe_wrappers import info as keys
from safe_wrappers.diagnosis import diagnose
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.wrappers.recording import RecordInterventions

from .evaluation.evaluate import typical_seed
from .files import say, write_bytes
from .policies import load_policy
from .run.stack import make_env
from .videos import drawing_without_a_screen, film_episode, for_film, why_blind

Policy = Callable[[Any], Any]


def enjoy_command(
    run: str,
    episodes: int,
    action_filter: Literal["trained", "none", "protect"],
    window: bool,
    film: Path | None,
    console: Console,
    imports: Collection[str] = (),
) -> None:
    """Lets a run's policy act, seeds 0, 1, ..., and prints what it comes to; the median episode's film is a WebP."""
    if episodes < 1:
        raise ConfigurationError(f"--episodes: expected at least 1, got {episodes}")
    trained = load_policy(run, other_filter=action_filter != "trained", imports=imports)
    mode = "human" if window else "rgb_array" if film is not None else None
    if mode is not None:
        with closing(trained.make_env("none")) as bare:
            blind = why_blind(bare, mode)
        if blind is not None:
            raise ConfigurationError(f"{'--render' if window else '--output'}: {blind}")
    found: list[dict[str, Any]] = []
    with closing(trained.make_env(action_filter, "human" if window else None)) as env:
        for seed in range(episodes):
            observation, info = env.reset(seed=seed)
            trained.reset()
            done = False
            while not done:
                observation, _, terminated, truncated, info = env.step(trained(observation))
                done = terminated or truncated
            found.append(info[keys.EPISODE_SUMMARY])
            say(console, f"episode {seed}: {_told(found[-1:])}")
    say(console, f"{trained.arm.name}, filter {action_filter}, mean of {episodes} episodes: {_told(found)}")
    if film is not None:
        typical = typical_seed({seed: episode["return"] for seed, episode in enumerate(found)})
        with (
            drawing_without_a_screen(),
            closing(for_film(trained.make_env(action_filter, "rgb_array"))) as env,
        ):
            data, said = film_episode(trained, env, typical)
        write_bytes(film, data)
        say(console, f"Film: {film}. {said}")


def _told(figures: list[dict[str, Any]]) -> str:
    """What episodes come to: their mean return, and by step what is counted by step."""
    steps = sum(episode["length"] for episode in figures)
    words = [f"return {sum(episode['return'] for episode in figures) / len(figures):.2f}", f"{steps:,} steps"]
    if all("violations" in episode for episode in figures):
        words.append(f"{sum(episode['violations'] for episode in figures):,} in violation")
    if all("intervention_rate" in episode for episode in figures):
        changed = sum(episode["intervention_rate"] * episode["length"] for episode in figures)
        words.append(f"{100 * changed / steps:.1f} % changed")
    return ", ".join(words)


def diagnose_command(
    env_id: str,
    policy: Path | None,
    steps: int,
    console: Console,
    imports: Collection[str] = (),
) -> None:
    """Diagnose an env by its id, and print what was found."""
    env, acts = (make_env(env_id, {}), None) if policy is None else of_run(policy, env_id, imports)
    say(console, "\n".join([f"{env_id}: {steps:,} steps", *map(str, diagnose(env, acts, steps))]))
    env.close()


def of_run(folder: Path, env_id: str, imports: Collection[str] = ()) -> tuple[gym.Env[Any, Any], Policy]:
    """The policy of a run's newest checkpoint, and its env without the filter."""
    trained = load_policy(folder, imports=imports)
    if trained.arm.env.id != env_id:
        raise ConfigurationError(
            f"--policy: {str(folder)!r} was trained on {trained.arm.env.id}, not on {env_id}: diagnose that env"
        )
    env = trained.make_env("none")
    while isinstance(env, Monitor | RecordInterventions):  # they belong outside of a filter
        env = env.env
    return env, trained
