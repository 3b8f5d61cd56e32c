"""A trained policy as it acts outside training, and as a folder for others."""

from __future__ import annotations

import re
import shutil
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, Literal

import gymnasium as gym
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

from safe_wrappers.plants.env_checks import wrappers_of
from safe_wrappers.wrappers.cbf_action_filter import filter_inside

from ..config.algorithms import SBX
from ..config.models import ArmConfig, FilterConfig
from ..files import write_json
from .checkpoint import NORMALIZE, load_model, save_policy
from .data_pickles import read_pickle
from .folder import POLICY
from .stack import make_stack

CONFIG: Final = "config.json"
_PACKAGES: Final = ("safe-wrappers", "stable-baselines3", "gymnasium", "mujoco")
_ADDRESS: Final = re.compile(r" at 0x[0-9a-f]+")


class TrainedPolicy:
    """The policy of a checkpoint, with the observation scaling and the action repeat that it was trained with.

    Attributes:
        arm: The arm.
        model: As SB3 loads it.
        deterministic: False: actions are drawn as in training, from torch's generator or the model's own key of JAX.
    """

    deterministic: bool = True

    def __init__(self, arm: ArmConfig, folder: Path) -> None:
        self.arm = arm
        self.model = load_model(folder, arm.algorithm, arm.device)
        scaling = folder / NORMALIZE
        self._normalize: VecNormalize | None = read_pickle(scaling) if scaling.exists() else None
        self.reset()

    def make_env(
        self, action_filter: Literal["trained", "none", "protect"] = "trained", render_mode: str | None = None
    ) -> gym.Env[Any, Any]:
        """The env that the policy was trained in, without what only training has (penalties, options of resets).

        Args:
            action_filter: The arm's own filter, or none, or `protect`'s.
            render_mode: As `gymnasium.make` takes it.
        """
        used = {"trained": self.arm.filter, "none": FilterConfig(), "protect": FilterConfig(protect={})}
        return make_stack(self.arm.env, used[action_filter], render_mode=render_mode)

    def reset(self) -> None:
        """Start an episode: its first action is the policy's."""
        self._held, self._left = None, 0

    def __call__(self, observation: Any) -> Any:
        """The action of a control step, for an observation as the env gives it."""
        if self._left == 0:
            self._held, self._left = self._decide(observation), self.arm.action_repeat
        self._left -= 1
        return self._held

    def _decide(self, observation: Any) -> Any:
        if self._normalize is not None:
            observation = self._normalize.normalize_obs(observation)
        return self.model.predict(observation, deterministic=self.deterministic)[0]


def write_policy(arm: ArmConfig, seed: int, run: Path, model: BaseAlgorithm) -> Path:
    """Writes the policy of a finished run into `RUN/policy/`: SB3's files, and what it was trained in as JSON.

    Returns:
        The folder; there is no half one.
    """
    folder, temporary = run / POLICY, run / f".{POLICY}"
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir()
    save_policy(temporary, model)
    packages = (*_PACKAGES, "sbx-rl") if arm.algorithm.startswith(SBX) else _PACKAGES
    config = {
        "arm": arm.name,
        "seed": seed,
        "config": arm.fingerprint(),
        "constraints": constraints_of_arm(arm),
        "timesteps": model.num_timesteps,
        "versions": {name: version(name) for name in packages},
    }
    write_json(temporary / CONFIG, config)
    shutil.rmtree(folder, ignore_errors=True)
    temporary.rename(folder)
    return folder


def constraints_of_arm(arm: ArmConfig) -> list[str]:
    """The constraints of an arm's filter in words, as this version of the library makes them."""
    env = make_stack(arm.env, arm.filter)
    try:
        return constraints_of(env)
    finally:
        env.close()


def constraints_of(env: gym.Env[Any, Any]) -> list[str]:
    """The constraints of the filter in an env's stack, in words; without a `CBFActionFilter` others' wrappers."""
    found = filter_inside(env)
    if found is not None:
        return [_ADDRESS.sub("", repr(constraint)) for constraint in found.constraints]
    packages = ("gymnasium", "stable_baselines3", "safe_wrappers")
    kinds = [type(wrapper) for wrapper in wrappers_of(env)]
    return [kind.__name__ for kind in kinds if kind.__module__.partition(".")[0] not in packages]
