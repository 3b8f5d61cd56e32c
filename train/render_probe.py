"""A process of its own that draws one frame: `python -m safe_wrappers.train.render_probe '["Id-v0", {}, []]'`.

The list is the asking process's `sys.path`: it may know modules that lie beside a config.
"""

from __future__ import annotations

import json
import os
import sys

import gymnasium as gym
import numpy as np

import safe_wrappers  # noqa: F401 (registers its tasks)

from .config import check_env_id


def main() -> None:
    """Exits with 0 if the task drew a frame."""
    env_id, kwargs, folders = json.loads(sys.argv[1])
    sys.path.extend(folder for folder in folders if folder not in sys.path)
    check_env_id(env_id)
    env = gym.make(env_id, **{**kwargs, "render_mode": "rgb_array"})
    env.reset(seed=0)
    frame = np.asarray(env.render())
    if frame.ndim != 3 or not frame.size:
        raise SystemExit(f"a frame of shape {frame.shape} is no picture")
    sys.stdout.flush()
    os._exit(0)  # the frame is there; what GL libraries do on their way out is of no interest


if __name__ == "__main__":
    main()
