"""What Stable-Baselines3 has pickled, read without running what it says.

A pickle may name any function of any module and have it called. What models hold is data: arrays, spaces, buffers,
statistics, settings. So this reader knows the names of these, and refuses a pickle that has any other.
"""

from __future__ import annotations

import base64
import importlib
import io
import json
import pickle
import zipfile
from collections import OrderedDict, deque
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common import utils
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.vec_env import VecNormalize

from safe_wrappers.errors import RunStateError

_PACKAGES: Final = frozenset(
    ("collections", "numpy", "torch", "gymnasium", "stable_baselines3", "sb3_contrib", "sbx", "safe_wrappers")
)
"""Nothing else is imported to see what a name is."""
_KINDS: Final = (
    *(OrderedDict, deque, np.ndarray, np.dtype, np.generic, np.random.BitGenerator, np.random.SeedSequence),
    *(torch.device, torch.optim.Optimizer, spaces.Space, BaseBuffer, ActionNoise, BasePolicy, RunningMeanStd),
    *(utils.ConstantSchedule, utils.FloatSchedule, utils.LinearSchedule, TrainFreq, TrainFrequencyUnit),
    VecNormalize,
)
"""Classes that are data, and their subclasses."""
_OTHERS: Final = {
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy._core.numeric", "_frombuffer"),
    ("numpy.random._pickle", "__bit_generator_ctor"),
    ("numpy.random._pickle", "__generator_ctor"),
    ("numpy.random.bit_generator", "__pyx_unpickle_SeedSequence"),
    ("safe_wrappers.info", "NOT_JUDGED"),
}
"""What NumPy makes its arrays and generators with, and a number of our own."""


class _Reader(pickle.Unpickler):
    """Finds classes of data, and no other name."""

    def __init__(self, data: Any, path: Path) -> None:
        super().__init__(data)
        self._path = path

    def find_class(self, module: str, name: str) -> Any:
        """What a pickle calls `module.name`."""
        known = module.partition(".")[0] in _PACKAGES and "." not in name
        found = getattr(importlib.import_module(module), name, None) if known else None
        if (module, name) in _OTHERS or (isinstance(found, type) and issubclass(found, _KINDS)):
            return found
        raise RunStateError(
            f"{str(self._path)!r} is refused: its pickle names {module}.{name}, which is no part of a policy, of a"
            " replay buffer or of statistics. A pickle can have run what it names; nothing of this one was."
        )


def read_pickle(path: Path) -> Any:
    """What is in a file that SB3 has pickled: a replay buffer, or running statistics.

    Raises:
        RunStateError: It names anything that is no data.
    """
    with path.open("rb") as file:
        return _Reader(file, path).load()


def pickles_of_model(path: Path) -> dict[str, Any]:
    """Everything that is pickled in a model which SB3 has saved, by name: the `custom_objects` of its `load`.

    SB3 unpickles nothing that it finds among those. Weights are no pickles: torch reads them with `weights_only`.

    Raises:
        RunStateError: A pickle names anything that is no data.
        ValueError, KeyError, zipfile.BadZipFile: It is no such file.
    """
    with zipfile.ZipFile(path) as archive:
        data = json.loads(archive.read("data"))
    return {
        name: _Reader(io.BytesIO(base64.b64decode(value[":serialized:"])), path).load()
        for name, value in data.items()
        if isinstance(value, dict) and ":serialized:" in value
    }
