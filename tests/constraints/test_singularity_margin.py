"""SingularityMargin: w against MuJoCo's Jacobians, and a threshold that is found by sampling."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from asking import asked
from scenes import Scene

import safe_wrappers as sw
from safe_wrappers.control.barriers import validated_threshold

CHAIN = """<mujoco><compiler angle="radian"/><option timestep="0.002"><flag contact="disable"/></option><worldbody>
<body name="base" pos=".1 0 1" euler="20 10 30"><joint name="rail" type="slide" axis="1 .2 0" range="-.5 .5"
  limited="true"/><geom size=".05"/>
<body name="upper" pos="0 .1 .1"><joint name="a" axis="0 1 0"/><joint name="b" axis=".3 0 1" pos=".1 0 0"/>
<geom type="capsule" fromto="0 0 0 .3 .1 0" size=".02"/>
<body name="lower" pos=".3 .1 0" euler="20 30 40"><joint name="c" axis="1 .2 0" range="-2 2" limited="true"/>
<geom name="shin" type="box" pos=".1 .05 .02" quat=".5 .5 .1 .2" size=".05 .02 .03"/>
<body name="hand" pos=".2 0 .1"><joint name="d" axis="0 0 1"/><geom size=".03"/>
<site name="tip" pos=".2 -.1 .05" euler="10 0 70"/></body></body></body></body></worldbody>
<actuator><motor joint="rail" ctrlrange="-50 50"/><motor joint="a" ctrlrange="-9 9"/>
<motor joint="b" ctrlrange="-9 9"/><motor joint="c" ctrlrange="-3 3"/></actuator></mujoco>"""
"""A slide and hinges, two in one body and off its origin, frames turned against each other; d has no motor."""
DRIVEN = ["rail", "a", "b", "c"]


def true_w(model, data, kind, name, joints, directions="xyz"):
    """sqrt(det) by the singular values of MuJoCo's own Jacobian; positions are up to date."""
    mujoco.mj_comPos(model, data)
    linear = np.zeros((3, model.nv))
    index = getattr(model, kind)(name).id
    call = {"body": mujoco.mj_jacBody, "site": mujoco.mj_jacSite, "geom": mujoco.mj_jacGeom}[kind]
    call(model, data, linear, None, index)
    rows = [linear["xyz".index(d)] for d in directions]
    columns = model.jnt_dofadr[[model.joint(j).id for j in joints]]
    return float(np.prod(np.linalg.svd(np.array(rows)[:, columns], compute_uv=False)))


TASKS = {
    "a site, all directions": ({"site": "tip"}, {}),
    "a geom, two directions": ({"geom": "shin", "directions": "zx"}, {"directions": "zx"}),
    "as many joints as directions": (
        {"site": "tip", "joints": ["a", "b", "c"]},
        {"joints": ["a", "b", "c"]},
    ),
}


@pytest.mark.parametrize("task", TASKS)
def test_w_is_that_of_mujoco_s_jacobian_now_and_ahead(task):
    arguments, truth = TASKS[task]
    env, threshold = Scene(CHAIN), 1e-3
    limit = asked(env, sw.constraints.SingularityMargin(threshold, horizon=2, **arguments))
    plant = limit.plant
    kind = next(k for k in ("site", "body", "geom") if k in arguments)
    rng, still = np.random.default_rng(0), mujoco.MjData(env.model)

    def expected(qpos):
        still.qpos[:] = qpos
        mujoco.mj_kinematics(env.model, still)
        return (
            true_w(env.model, still, kind, arguments[kind], **{"joints": DRIVEN, **truth}) / threshold - 1.0
        )

    for _ in range(8):
        env.data.qpos[:], env.data.qvel[:] = rng.uniform(-1.5, 1.5, (2, 5))
        plant.observe()
        assert limit.value() == pytest.approx(expected(env.data.qpos), rel=1e-9, abs=1e-9)
        forecast = plant.rollout(rng.uniform(-3.0, 3.0, 4), 2)
        room = limit.h_along(forecast)
        assert room.shape == (10, 1)
        for k in range(10):
            # Beyond a singular pose a square task counts as negative; the difference has a test of its own.
            assert abs(room[k, 0] + 1.0) == pytest.approx(
                expected(forecast.qpos[k]) + 1.0, rel=1e-8, abs=1e-8
            )


def test_a_square_task_is_not_passed_through_its_singular_pose():
    env = gym.make("Reacher-v5")
    spec = sw.constraints.SingularityMargin(0.003, body="fingertip", directions="xy")
    for side in (1.0, -1.0):
        env.reset(seed=0)
        env.unwrapped.set_state(
            np.array([0.3, side * 0.5, 0.1, -0.1]), np.array([0.0, -side * 40.0, 0.0, 0.0])
        )
        limit = asked(env, spec)
        assert limit.value() == pytest.approx(0.011 * np.sin(0.5) / 0.003 - 1.0)
        forecast = limit.plant.rollout(np.zeros(2), 2)
        crossing = forecast.qpos[:, 1]
        assert (crossing * side).min() < -0.2  # it does pass through, to where w is large again
        np.testing.assert_allclose(
            limit.h_along(forecast)[:, 0], side * 0.011 * np.sin(crossing) / 0.003 - 1.0
        )
        assert not limit.admits(np.zeros(2))


# A validated threshold ----------------------------------------------------------------------------------------


def test_a_validated_threshold_is_that_of_the_sampled_configurations():
    env = Scene(CHAIN)
    limit = asked(env, sw.constraints.SingularityMargin(site="tip", task_speed=0.1, rate_limit=2.0))
    found = limit.spec.validated
    # A second draw, by MuJoCo's Jacobians: what exceeds above the threshold is as rare as the sample says.
    rng, data, jacobians = np.random.default_rng(5), mujoco.MjData(env.model), []
    for _ in range(2000):
        data.qpos[:] = rng.uniform([-0.5, -np.pi, -np.pi, -2.0, -np.pi], [0.5, np.pi, np.pi, 2.0, np.pi])
        mujoco.mj_kinematics(env.model, data)
        mujoco.mj_comPos(env.model, data)
        linear = np.zeros((3, 5))
        mujoco.mj_jacSite(env.model, data, linear, None, env.model.site("tip").id)
        jacobians.append(linear[:, :4])
    assert validated_threshold(jacobians, 0.1, 2.0) == pytest.approx(found, rel=0.2)
    w = np.prod(np.linalg.svd(jacobians, compute_uv=False), axis=1)
    need = 0.1 * np.linalg.norm(np.linalg.pinv(jacobians), axis=2).max(axis=1)
    # With 99 % confidence no more than this share is left unseen by 2,000 samples.
    assert ((w > found) & (need > 2.0)).mean() <= 2.0 * (1.0 - 0.01 ** (1.0 / 2000.0))
    given = asked(env, sw.constraints.SingularityMargin(found, site="tip"))
    assert given.spec.validated is None and given.value() == limit.value()


def test_a_pose_with_a_position_that_is_no_number_has_no_manipulability():
    env = gym.make("Reacher-v5")
    limit = asked(env, sw.constraints.SingularityMargin(1e-4, body="fingertip", directions="xy"))
    path = limit.plant.rollout(np.zeros(2), 2)
    path.qpos[:3] = [0.3, 0.8, 0.1, 0.1]
    # The target's position, which does not carry the arm, and the arm's own.
    path.qpos[1, 2], path.qpos[2, 0] = np.nan, np.inf
    found = limit.h_along(path)[:3, 0]
    assert found[0] == pytest.approx(0.1 * 0.11 * np.sin(0.8) / 1e-4 - 1.0) and np.isnan(found[1:]).all()
