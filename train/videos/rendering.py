"""Whether a task can draw frames on this machine, found out without risking this process.

`python -m safe_wrappers.train.videos.rendering '["Id-v0", {}, []]'` draws one frame; the list is the asking process's
`sys.path`: it may know modules that lie beside a config.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from typing import Final

import gymnasium as gym
import numpy as np

import safe_wrappers  # noqa: F401 (registers its tasks)

from ..config import EnvConfig, check_env_id

_SECONDS: Final = 60.0
"""A GL library that waits for a display never comes back."""
_INSTALL: Final = (
    "Run safe-wrappers evaluate again with MUJOCO_GL=egl, or with MUJOCO_GL=osmesa after apt install libosmesa6"
    " (Debian, Ubuntu)."
)


@dataclass(frozen=True)
class Rendering:
    """Either the environment variables under which frames are drawn, or one line that says why none are."""

    variables: dict[str, str]
    problem: str = ""


def find_rendering(env: EnvConfig) -> Rendering:
    """Makes the task in a process of its own and asks it for a frame.

    A GL library may abort the process, hang, or raise as soon as it is imported. MUJOCO_GL is respected where
    it is set, "disabled" too; else Linux tries EGL, then OSMesa.

    Args:
        env: The task.
    """
    given = os.environ.get("MUJOCO_GL")
    tried = [given] if given else (["egl", "osmesa"] if sys.platform == "linux" else [""])
    reasons = []
    for choice in tried:
        variables = {"MUJOCO_GL": choice} if choice else {}
        reason = _probe(env, variables)
        if not reason:
            return Rendering(variables)
        reasons.append(f"MUJOCO_GL={choice}: {reason}" if choice else reason)
    return Rendering({}, f"{env.id} could not draw a frame here ({'; '.join(reasons)}). {_INSTALL}")


def _probe(env: EnvConfig, variables: dict[str, str]) -> str:
    """What went wrong; empty if a frame was drawn."""
    command = [sys.executable, "-m", __name__, json.dumps([env.id, env.kwargs, sys.path])]
    around = {**os.environ, **variables}
    try:
        done = subprocess.run(
            command, env=around, capture_output=True, text=True, timeout=_SECONDS, check=False
        )
    except subprocess.TimeoutExpired:
        return f"no frame within {_SECONDS:.0f} s"
    if done.returncode == 0:
        return ""
    lines = done.stderr.strip().splitlines()
    if done.returncode < 0 or not lines:
        return f"the process ended with status {done.returncode}"
    return lines[-1][:120]


def _draw_a_frame() -> None:
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
    _draw_a_frame()
