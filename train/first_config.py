"""A first config of one's own, with a word on each key: `safe-wrappers init`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from rich.console import Console

import safe_wrappers
from safe_wrappers.errors import ConfigurationError

from .atomic import write_text
from .config import parse_experiment, read_config
from .config.algorithms import DETERMINISTIC
from .config.env_ids import make_env
from .config.names import check_name
from .filter_module import filter_module, is_known
from .hyperparameters import check_task

DEFAULT: Final = Path("experiment.yaml")
_FILLED: Final = {"env": "SafePointGoal1-v0", "algorithm": "PPO"}
_RECIPE: Final = 'protect  # this library\'s recipe; for a filter of your own {factory: "module:function"}'
_OF_ITS_OWN: Final = '{{factory: "{module}:filtered"}}  # the function in {module}.py; protect has no recipe'
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
    filter: {filter}
    #learner: {{kind: adaption_penalty, penalty: 0.1}}  # what the learner sees of a changed action
seeds: [0]  # every arm is trained with each
#workers: 2  # runs at a time; by default one per core
#checkpoint_every: 10_000
evaluation: {{episodes: 20}}
"""


def init_command(path: Path | None, overrides: Sequence[str], console: Console) -> Path:
    """Writes a commented config, for an env without a recipe with a module of its filter beside it.

    Args:
        path: The file; None: `experiment.yaml`.
        overrides: `env=ID` and `algorithm=NAME`.
        console: Where it is told.

    Raises:
        ConfigurationError: A file exists, or what the config would say is refused: the env cannot be made, no filter
            fits it, or the algorithm does not.
    """
    path = path or DEFAULT
    filled = dict(_FILLED)
    for override in overrides:
        key, _, value = override.partition("=")
        filled[check_name(key, _FILLED, "init")] = value
    module = path.parent / f"{re.sub(r'[^A-Za-z0-9_]', '_', path.stem)}_filter.py"
    env = make_env(filled["env"], {})
    code = "" if is_known(env) else filter_module(env, module.name)
    for written in [path, *([module] if code else [])]:
        if written.exists():
            raise ConfigurationError(
                f"{str(written)!r} is there already; give another name: safe-wrappers init NAME.yaml"
            )
    noisy = filled["algorithm"] in DETERMINISTIC  # they need a word on it
    given = (
        "hyperparameters: {action_noise: {normal: 0.1}}"
        if noisy
        else "#hyperparameters: {learning_rate: 1e-4}"
    )
    chosen = _OF_ITS_OWN.format(module=module.stem) if code else _RECIPE
    text = _TEMPLATE.format(name=path.stem, path=path, hyperparameters=given, filter=chosen, **filled)
    write_text(path, text)
    try:
        for arm in parse_experiment(read_config(path)).arms:
            check_task(arm, env)
        if not code:
            safe_wrappers.protect(env)
    except ConfigurationError:
        path.unlink()
        raise
    if code:
        write_text(module, code)
    console.print(f"Written: {path}", soft_wrap=True, highlight=False)
    if code:
        console.print(
            f"Written: {module}, the filter of the arm `filtered`, to be adapted",
            soft_wrap=True,
            highlight=False,
        )
    return path
