"""A first config of one's own, with a word on each key: `safe-wrappers init`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from rich.console import Console

from safe_wrappers.errors import ConfigurationError

from .atomic import write_text
from .config import parse_experiment, read_config
from .config.algorithms import DETERMINISTIC
from .config.names import check_name

DEFAULT: Final = Path("experiment.yaml")
_FILLED: Final = {"env": "SafePointGoal1-v0", "algorithm": "PPO"}
_TEMPLATE: Final = """\
# Trained without and with the filter, then evaluated on the same episodes:
#   safe-wrappers compare {path} --report
# What is commented out is an example; `safe-wrappers list` has the names, docs/config.md every key.
name: {name}  # the folder below `output`
env: {env}  # an id of gymnasium.make; {{id: ..., kwargs: {{...}}}} with arguments of the env
algorithm: {algorithm}
total_steps: 100_000  # of all envs together, rounded up to whole rollouts
n_envs: 4
#vec_env: subproc  # each env in a process of its own
#action_repeat: 4  # control steps for which the policy holds an action; the filter checks each
#normalize: {{observation: true}}
{hyperparameters}  # by SB3's names; `linear_3e-4`: falls to 0 over total_steps
arms:  # what is compared
  unfiltered: {{filter: none}}
  filtered:
    filter: protect  # this library's recipe; for a filter of your own {{factory: "module:function"}}
    #learner: {{kind: adaption_penalty, penalty: 0.1}}  # what the learner sees of a changed action
seeds: [0]  # every arm is trained with each
#workers: 2  # runs at a time; by default one per core
#checkpoint_every: 10_000
evaluation: {{episodes: 20}}
"""


def init_command(path: Path | None, overrides: Sequence[str], console: Console) -> Path:
    """Writes a commented config that works as it is.

    Args:
        path: The file; None: `experiment.yaml`.
        overrides: `env=ID` and `algorithm=NAME`.
        console: Where it is told.

    Raises:
        ConfigurationError: The file exists, or what it would say is refused.
    """
    path = path or DEFAULT
    filled = dict(_FILLED)
    for override in overrides:
        key, _, value = override.partition("=")
        filled[check_name(key, _FILLED, "init")] = value
    if path.exists():
        raise ConfigurationError(
            f"{str(path)!r} is there already; give another name: safe-wrappers init NAME.yaml"
        )
    noisy = filled["algorithm"] in DETERMINISTIC  # they need a word on it
    given = (
        "hyperparameters: {action_noise: {normal: 0.1}}"
        if noisy
        else "#hyperparameters: {learning_rate: 1e-4}"
    )
    write_text(path, _TEMPLATE.format(name=path.stem, path=path, hyperparameters=given, **filled))
    try:
        parse_experiment(read_config(path))
    except ConfigurationError:
        path.unlink()
        raise
    console.print(f"Written: {path}", soft_wrap=True, highlight=False)
    return path
