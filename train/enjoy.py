"""A trained policy to look at: `safe-wrappers enjoy RUN`."""

from __future__ import annotations

from collections.abc import Callable, Collection
from contextlib import closing
from pathlib import Path
from typing import Any, Literal

from rich.console import Console

from safe_wrappers import info as keys
from safe_wrappers.errors import ConfigurationError

from .evaluation.episode_selection import filmed_seeds, typical_and_worst
from .files import write_bytes
from .policies import load_policy
from .processes import environment
from .run.policy import TrainedPolicy
from .videos.film import film_episodes, for_film
from .videos.rendering import find_rendering

FilterName = Literal["trained", "none", "protect", "both"]


def enjoy_command(
    run: str,
    episodes: int,
    action_filter: FilterName,
    window: bool,
    film: Path | None,
    console: Console,
    imports: Collection[str] = (),
) -> None:
    """Lets a run's policy act, and prints what it comes to.

    Args:
        run: As `load_policy` takes it.
        episodes: How many; their env seeds are 0, 1, 2, ...
        action_filter: The filter that it was trained with, or another; `both`: without a filter, then with the one
            that it was trained with, or `protect`'s if it was trained without.
        window: The task draws itself in a window.
        film: Where to write a film (WebP) of the episodes with the median return and with the lowest; with `both`
            of those in the filter that it was trained with.
        console: Where to print.
        imports: As `load_policy` takes it.

    Raises:
        ConfigurationError: No such run, no episode, or the task cannot be drawn in this way.
    """
    if episodes < 1:
        raise ConfigurationError(f"--episodes: expected at least 1, got {episodes}")
    trained = load_policy(run, other_filter=action_filter != "trained", imports=imports)
    _check_modes(trained, "human" if window else "rgb_array" if film is not None else None)

    def say(line: str) -> None:
        console.print(line, highlight=False, markup=False, soft_wrap=True)

    own = trained.arm.filter.kind != "none"
    steps = trained.arm.total_steps * trained.arm.action_repeat
    say(
        f"{run}: {trained.arm.algorithm} on {trained.arm.env.id}, trained for {steps:,} control steps"
        f" {'through the filter' if own else 'without a filter'}"
    )
    both = action_filter == "both"
    for name in ("none", "trained" if own else "protect") if both else (action_filter,):
        figures = _drive(trained, name, episodes, window, None if both else say)
        on = name == "protect" or (name == "trained" and own)
        say(
            f"{trained.arm.name}, filter {'on' if on else 'off'}, mean of {episodes} episodes: {_told(figures)}"
        )
        if film is not None and (on == own or not both):
            returns = {seed: episode["return"] for seed, episode in enumerate(figures)}
            say(_film(trained, name, returns, film))


def _check_modes(trained: TrainedPolicy, render_mode: str | None) -> None:
    if render_mode is None:
        return
    env = trained.make_env("none")
    modes = env.unwrapped.metadata.get("render_modes") or []
    env.close()
    if render_mode not in modes:
        wanted, other = ("window", "--output FILM.webp") if render_mode == "human" else ("frames", "--render")
        raise ConfigurationError(
            f"{trained.arm.env.id} draws no {wanted} (its render modes: {', '.join(modes) or 'none'}); try {other},"
            " or leave it out"
        )


def _drive(
    trained: TrainedPolicy, used: Any, episodes: int, window: bool, say: Callable[[str], None] | None
) -> list[dict[str, Any]]:
    """Runs episodes; returns their figures, each of which is told as it ends."""
    found = []
    with closing(trained.make_env(used, "human" if window else None)) as env:
        for seed in range(episodes):
            observation, _ = env.reset(seed=seed)
            trained.begin(env)
            done = False
            while not done:
                observation, _, terminated, truncated, info = env.step(trained(observation))
                done = terminated or truncated
            found.append(info[keys.EPISODE_SUMMARY])
            if say is not None:
                say(f"episode {seed}: {_told(found[-1:])}")
    return found


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


def _film(trained: TrainedPolicy, used: Any, returns: dict[int, float], path: Path) -> str:
    """Films the typical episode, and the worst beside it; the line that says so, or why there is no film."""
    rendering = find_rendering(trained.arm.env)
    if rendering.problem:
        return f"No film: {rendering.problem}"
    typical, worst = typical_and_worst(returns)
    with environment(rendering.variables), closing(for_film(trained.make_env(used, "rgb_array"))) as env:
        write_bytes(path, film_episodes(trained, env, filmed_seeds(typical, worst))[0])
    beside = "" if worst == typical else f", beside it {worst}, the lowest"
    return f"Film: {path} (episode {typical} has the median return{beside})"
