"""A model as a file: SB3's own, read as data, in which what sbx's models hold of JAX is arrays.

SB3 would pickle that, functions and all. Instead a model that is loaded makes its functions anew, from the settings
that are stored, and is given the arrays.
"""

from __future__ import annotations

import copy
import zipfile
from pathlib import Path
from typing import Any, Final

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from .data_pickles import pickles_of_model

_ARRAYS: Final = "jax.msgpack"
_CLASS: Final = "policy_class_in_jax"
_PACKAGES: Final = ("sbx", "flax", "jax", "jaxlib")


def _package(value: object) -> str:
    return type(value).__module__.partition(".")[0]


def write_model(model: BaseAlgorithm, path: Path) -> None:
    """Saves a model."""
    if _package(model) != "sbx":
        model.save(path)
        return
    from flax import serialization

    stored: Any = copy.copy(model)
    setattr(stored, _CLASS, model.policy_class)
    # sbx would load it as a network that has learned nothing; this is refused, as "Policy ... unknown".
    stored.policy_class = f"(its arrays are in {_ARRAYS}: safe_wrappers.train.policies.load_policy)"
    stored.save(path, exclude=[name for name, value in vars(model).items() if _package(value) in _PACKAGES])
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(_ARRAYS, serialization.to_bytes(_arrays(model)))


def read_model(
    kind: type[BaseAlgorithm], path: Path, env: VecEnv | None, device: str, changed: dict[str, Any]
) -> BaseAlgorithm:
    """The model of a file, with attributes that are changed before it is made.

    Raises:
        RunStateError: A pickle names anything that is no data.
        OSError, ValueError, KeyError, zipfile.BadZipFile: It is no such file, or has another network's arrays.
    """
    known = pickles_of_model(path) | changed
    if _CLASS not in known:
        return kind.load(path, env, device, custom_objects=known)
    import jax
    from flax import serialization

    model = kind.load(path, env, device, custom_objects=known | {"policy_class": known[_CLASS]})
    with zipfile.ZipFile(path) as archive:
        arrays = serialization.from_bytes(_arrays(model), archive.read(_ARRAYS))
    arrays = jax.tree.map(jax.numpy.asarray, arrays)  # NumPy's would be copied at every use
    vars(model).update(arrays["model"])
    vars(model.policy).update(arrays["policy"])
    return model


def _arrays(model: BaseAlgorithm) -> dict[str, dict[str, Any]]:
    """Networks with their optimizers, and the keys of random numbers: all that training changes."""
    import jax
    from flax.training.train_state import TrainState

    return {
        owner: {name: value for name, value in held.items() if isinstance(value, TrainState | jax.Array)}
        for owner, held in (("model", vars(model)), ("policy", vars(model.policy)))
    }
