"""The robot is inside the picture, by MuJoCo's own camera, wherever it goes."""

from types import SimpleNamespace

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import safe_wrappers  # noqa: F401  (registers its envs)
from safe_wrappers.train.videos import for_film
from safe_wrappers.wrappers.safety_overlay import find_renderer

ROBOTS = {
    "SafePointGoal1-v0": "agent",
    "SafeCarGoal1-v0": "agent",
    "SafeRover-v0": "rover",
    "OccludedCrossing-v0": "robot",
    "PatrolledPointMaze-v0": "particle",
    "SafeHalfCheetahVelocity-v0": "torso",
    "SafeSwimmerVelocity-v0": "torso",
    "Hopper-v5": "torso",
}


def filmed(env_id, monkeypatch):
    """An env as films have it, without GL; and what tells where a frame has the robot."""
    env = for_film(gym.make(env_id, render_mode="rgb_array"))
    renderer = find_renderer(env)
    model, data, camera = renderer.model, renderer.data, mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, camera)
    for key, value in (renderer.default_cam_config or {}).items():
        if key != "type":
            setattr(camera, key, value)
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE  # as Gymnasium's renderer has it
    scene = mujoco.MjvScene(model, 1000)
    body, places = model.body(ROBOTS[env_id]).id, []

    def render(mode):
        mujoco.mjv_updateScene(
            model, data, mujoco.MjvOption(), None, camera, mujoco.mjtCatBit.mjCAT_ALL, scene
        )
        left, right = scene.camera
        seen = data.xpos[body] - (np.array(left.pos) + right.pos) / 2.0
        forward, up = np.array(left.forward), np.array(left.up)
        height = left.frustum_top / left.frustum_near * (seen @ forward)
        width = height * renderer.width / renderer.height
        places.append(np.array([seen @ np.cross(forward, up) / width, seen @ up / height]))
        return np.zeros((renderer.height, renderer.width, 3), dtype=np.uint8)

    def frame():
        mujoco.mj_forward(model, data)
        env.render()
        return places[-1]

    monkeypatch.setattr(renderer, "_get_viewer", lambda mode: SimpleNamespace(cam=camera, scn=scene))
    monkeypatch.setattr(renderer, "render", render)
    return env, data, frame


@pytest.mark.parametrize("env_id", ROBOTS)
def test_the_robot_stays_in_sight_wherever_it_goes(env_id, monkeypatch):
    env, data, frame = filmed(env_id, monkeypatch)
    env.reset(seed=0)
    start = data.qpos[0]
    for away in (0.0, 3.0, -8.0, 20.0):
        data.qpos[0] = start + away
        assert (np.abs(frame()) < 0.8).all()
    env.close()
