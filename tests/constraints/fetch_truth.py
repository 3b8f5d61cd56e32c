"""A Fetch env that looks at itself after every physics substep: its own step, one substep at a time."""

import mujoco
import numpy as np

ARM = [
    f"robot0:{name}_joint"
    for name in (
        "shoulder_pan",
        "shoulder_lift",
        "upperarm_roll",
        "elbow_flex",
        "forearm_roll",
        "wrist_flex",
        "wrist_roll",
    )
]


def watch(env, length):
    """Make an env write down w of its gripper's whole twist, and joint rates, at every substep of each step.

    Args:
        env: Of the Fetch kind.
        length: By which a rotation counts, m.

    Returns:
        A list that every step refills with (w, largest joint rate of the arm in rad/s).
    """
    raw, seen = env.unwrapped, []
    model, still = raw.model, mujoco.MjData(raw.model)
    dofs = model.jnt_dofadr[[model.joint(name).id for name in ARM]]
    site = model.site("robot0:grip").id

    def w(qpos):
        still.qpos[:] = qpos
        mujoco.mj_kinematics(model, still)
        mujoco.mj_comPos(model, still)
        linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        mujoco.mj_jacSite(model, still, linear, angular, site)
        task = np.concatenate([linear, length * angular])[:, dofs]
        return float(np.prod(np.linalg.svd(task, compute_uv=False)))

    def step(action):
        seen.clear()
        for _ in range(raw.n_substeps):
            mujoco.mj_step(model, raw.data)
            seen.append((w(raw.data.qpos), float(np.abs(raw.data.qvel[dofs]).max())))

    raw._mujoco_step = step
    return seen
