"""The frames of docs/wrappers/safety-overlay.md: one of each task, at a step at which something is to be seen.

    MUJOCO_GL=osmesa python -m benchmarks.overlay_frames [NAME ...]

Nothing is trained: seeded drivers that make life hard for a filter.
"""

import argparse
import io
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from PIL import Image

import safe_wrappers as sw
from benchmarks import car_drivers, crossing_drivers, drivers, mujoco_drivers, patrol_drivers
from safe_wrappers.drawing.scene import find_renderer, set_size
from safe_wrappers.envs.safe_rover import WHEELS
from safe_wrappers.envs.traffic import CAR_ACCELERATION_NOISE, CAR_TIME_CONSTANT_S

FOLDER = Path(__file__).parents[1] / "docs" / "static" / "overlay"
WIDTH, HEIGHT, QUALITY = 640, 480, 70
Env = gym.Env[Any, Any]
Driver = Callable[[], Any]


@dataclass
class Scene:
    """One frame: a task in its wrappers, who drives, and when it is taken."""

    task: str
    wrap: Callable[[Env], Env]
    driver: Callable[[Any, np.random.Generator], Driver]
    when: Callable[[dict[str, Any]], bool]
    after: int = 20
    """Steps before which no frame is taken."""
    camera: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] | None = None
    seed: int = 0


def _changed(info: dict[str, Any]) -> bool:
    return bool(info["cbf/intervened"])


def _tracked(env: Env) -> Env:
    cars = [
        sw.occlusion.Track(
            name,
            acceleration_noise=[CAR_ACCELERATION_NOISE, 0.0],
            reversion_s=CAR_TIME_CONSTANT_S,
            mean_velocity=[mean, 0.0],
            start_position_std=[0.3, 0.0],
            start_velocity_std=[0.15, 0.0],
        )
        for name, mean in (("car[012]", 1.0), ("car[345]", -1.0))
    ]
    eye = sw.occlusion.Sensor(camera="eye", view_deg=100, range_m=9, position_std=0.05)
    return sw.protect(sw.OcclusionPenalty(env, cars, eye, tolerance=0.5))


def _leased(env: Env) -> Env:
    """A lease, and a link that falls silent."""
    env = sw.protect(env)
    lease = sw.LeaseExpiry(env, sw.StoppingBudget(env.constraints[0], closing_speed=4.0))  # type: ignore[attr-defined]
    return sw.faults.Outages(lease, mean_between_s=0.3, mean_length_s=1.0)


def _full(
    driver: Callable[[Any, np.random.Generator], Driver],
) -> Callable[[Any, np.random.Generator], Driver]:
    """The same driver with the whole of the action space: the car's motors saturate far inside of it."""

    def made(env: Any, rng: np.random.Generator) -> Driver:
        act = driver(env, rng)
        return lambda: 50.0 * act()

    return made


def _held(*action: float) -> Callable[[Any, np.random.Generator], Driver]:
    return lambda env, rng: lambda: np.array(action)


_ABOVE = {"distance": 3.4, "elevation": -62.0, "azimuth": 90.0}
SCENES = {
    "point": Scene(
        "SafePointGoal1-v0",
        sw.protect,
        drivers.hazard_seeking,
        lambda info: _changed(info) and info["cbf/margin"] > 0.01,
        camera=_ABOVE | {"lookat": np.array([-0.2, -0.1, 0.0])},
        after=40,
    ),
    "car": Scene(
        "SafeCarGoal1-v0",
        sw.protect,
        _full(car_drivers.hazard_seeking),
        _changed,
        camera=_ABOVE | {"lookat": np.array([0.0, 0.0, 0.0])},
        after=60,
    ),
    "fetch": Scene(
        "FetchReach-v4",
        sw.protect,
        _held(1.0, 0.4, -1.0, 0.0),
        _changed,
        camera={"distance": 1.9, "elevation": -20.0, "azimuth": 140.0, "lookat": np.array([1.3, 0.75, 0.55])},
        after=4,
    ),
    "patrols": Scene("PatrolledPointMaze-v0", sw.protect, patrol_drivers.patrol_seeking, _changed, after=60),
    "cheetah": Scene(
        "HalfCheetah-v5",
        lambda env: sw.CBFActionFilter(env, [sw.constraints.SpeedLimit(1.5, body="torso", direction="x")]),
        mujoco_drivers.speed_seeking,
        _changed,
        after=30,
    ),
    "joints": Scene(
        "HalfCheetah-v5",
        lambda env: sw.CBFActionFilter(env, [sw.constraints.JointPositionLimit()]),
        lambda env, rng: lambda: rng.uniform(-1.0, 1.0, 6),
        _changed,
        camera={"distance": 2.6},
    ),
    "reacher": Scene("Reacher-v5", sw.protect, _held(1.0, -1.0), _changed, camera={"distance": 0.6}),
    "crossing": Scene("OccludedCrossing-v0", _tracked, crossing_drivers.goal_seeking, _changed, after=30),
    "rover": Scene(
        "SafeRover-v0",
        lambda env: sw.SlipLimiter(env, wheels=list(WHEELS)),
        _held(1.0, 1.0, 1.0, 1.0, 0.3),
        _changed,
        camera={"distance": 8.0},
    ),
    "ant": Scene(
        "Ant-v5",
        lambda env: sw.WholeBodyFilter(env, friction_share=0.7, zmp_inset=0.02),
        lambda env, rng: lambda: 0.5 * rng.uniform(-1.0, 1.0, 8),
        lambda info: info["whole_body/contacts"] > 3,
        after=30,
    ),
    "teleop": Scene(
        "TeleopContact-v0",
        lambda env: sw.TeleopChannel(sw.protect(env), sw.teleop.Link(0.02), sw.teleop.Link(0.02)),
        mujoco_drivers.clamp_seeking,
        _changed,
        after=60,
    ),
    "lease": Scene(
        "SafePointGoal1-v0",
        _leased,
        drivers.hazard_seeking,
        lambda info: bool(info["lease/braking"]),
        camera=_ABOVE,
        after=60,
        seed=1,
    ),
    "pendulum": Scene("Pendulum-v1", sw.protect, _held(2.0), _changed, after=70),
}


def shot(scene: Scene, steps: int = 1500) -> np.ndarray[Any, Any]:
    """The frame of a scene."""
    import gymnasium_robotics

    gym.register_envs(gymnasium_robotics)
    env = gym.make(scene.task, render_mode="rgb_array", max_episode_steps=steps + 1)
    set_size(env, WIDTH, HEIGHT)
    renderer = find_renderer(env)
    if renderer is not None:
        renderer.default_cam_config = {**(renderer.default_cam_config or {}), **scene.camera}
    env = sw.SafetyOverlay(scene.wrap(env))
    env.reset(seed=scene.seed, options=scene.options)
    act = scene.driver(env.unwrapped, np.random.default_rng(scene.seed))
    for step in range(steps):
        action = np.asarray(act(), dtype=env.action_space.dtype)
        _, _, terminated, truncated, info = env.step(action)
        if step >= scene.after and scene.when(info):
            break
        if terminated or truncated:
            env.reset()
    frame = np.asarray(env.render())
    env.close()
    return frame


def main() -> None:
    """Draw all frames, or some."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("names", nargs="*", default=list(SCENES), metavar="NAME", help=", ".join(SCENES))
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name in parser.parse_args().names:
        data = io.BytesIO()
        Image.fromarray(shot(SCENES[name])).save(data, "WEBP", quality=QUALITY, method=6)
        (FOLDER / f"{name}.webp").write_bytes(data.getvalue())
        print(f"{name}: {data.tell() / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
