"""A policy of sbx.SAC as one of Stable-Baselines3's SAC, which acts without JAX: the same actor, untrained critics.

    python -m benchmarks as_sb3 --run runs/SafePointGoal1_sac_sbx_2m/filtered/seed_0 --to configs/policies/filtered

The run keeps its own policy. The card is the run's.
"""

import shutil
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.vec_env import DummyVecEnv

from benchmarks.tables import options
from safe_wrappers.train.files import read_json
from safe_wrappers.train.policies import CARD, load_policy, write_card
from safe_wrappers.train.run.folder import POLICY
from safe_wrappers.train.run.model import new_model
from safe_wrappers.train.run.policy import CONFIG, write_policy


def main() -> None:
    """Write the policy's folder anew."""
    arguments = options(__doc__, run=Path, to=Path)
    run, to = arguments.run, arguments.to
    trained = load_policy(run / POLICY, other_filter=True)
    arm, space = trained.arm, trained.model.observation_space
    sb3 = replace(arm, algorithm="SAC")
    config = read_json(run / POLICY / CONFIG)
    model: Any = new_model(sb3, config["seed"], DummyVecEnv([trained.make_env]))
    model.num_timesteps = config["timesteps"]
    layers = trained.model.policy.actor_state.params["params"]
    hidden = [layer for layer in model.actor.latent_pi if isinstance(layer, torch.nn.Linear)]
    with torch.no_grad():
        for number, layer in enumerate([*hidden, model.actor.mu, model.actor.log_std]):
            kernel, bias = (
                torch.tensor(layers[f"Dense_{number}"][part].tolist()) for part in ("kernel", "bias")
            )
            layer.weight.copy_(kernel.T)
            layer.bias.copy_(bias)
    space.seed(0)
    seen = np.stack([space.sample() for _ in range(1000)])
    here, there = (policy.predict(seen, deterministic=True)[0] for policy in (model, trained.model))
    print(f"over 1,000 observations an action component differs by {np.abs(here - there).max():.1g} at most")
    with TemporaryDirectory() as made:
        shutil.rmtree(to, ignore_errors=True)
        shutil.copytree(write_policy(sb3, config["seed"], Path(made), model), to)
    write_card(arm, config["seed"], run)
    shutil.copy(run / POLICY / CARD, to / CARD)
