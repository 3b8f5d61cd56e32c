"""A planar robot in a MuJoCo model: its joints and actuators, its motion, and its constants."""

import math

import mujoco
import numpy as np

from safe_wrappers.control.backup.heading_drive import HeadingDrive
from safe_wrappers.errors import UnsupportedEnvError
from safe_wrappers.plants.mujoco.binding import refuse_mapped
from safe_wrappers.plants.mujoco.model import AT_A_JOINT, HINGE, SLIDE
from safe_wrappers.plants.mujoco.plant import MujocoPlant

_AT_SITE = int(mujoco.mjtTrn.mjTRN_SITE)


class PlanarFrame:
    """A body that slides along x and y and turns about z, driven along its heading and about its hinge.

    Attributes:
        joints: Indices of the two slides and of the hinge.
        place: Indices of the first slide in qpos and qvel, and where the body is at qpos = 0, x and y, m.
        drive_index: Of the actuator along the heading.
        turn_index: Of the one on the hinge.
    """

    def __init__(self, plant: MujocoPlant, body: str) -> None:
        refuse_mapped(plant.action_map, "the closed form of a planar robot's motion")
        m = plant.model
        b = plant.named("body", body)
        joints = np.flatnonzero(m.jnt_bodyid == b).tolist()
        kinds = [int(m.jnt_type[j]) for j in joints]
        axes = m.jnt_axis[joints] if joints else np.zeros((0, 3))
        planar = (
            kinds == [SLIDE, SLIDE, HINGE]
            and m.body_parentid[b] == 0
            and np.allclose(axes, np.eye(3), atol=1e-9)
            and np.allclose(m.body_quat[b], [1, 0, 0, 0], atol=1e-9)
            and np.allclose(m.jnt_pos[joints[2]], 0.0)
        )
        if not planar:
            raise UnsupportedEnvError(
                f"body {body!r} must slide along world x and y and turn about z (slide, slide, hinge, in this "
                f"order); it has {[mujoco.mjtJoint(k).name[6:].lower() for k in kinds]}. Use Clearance for "
                "other machines."
            )
        self.joints = joints
        first = m.jnt_qposadr[joints[0]], m.jnt_dofadr[joints[0]]
        self.place = np.array([*first, *m.body_pos[b][:2]], dtype=np.float64)
        if m.nu != 2:
            raise UnsupportedEnvError(
                f"expected 2 actuators, a drive and a turning one; the model has {m.nu}"
            )
        kind, at, gear = m.actuator_trntype, m.actuator_trnid[:, 0], m.actuator_gear
        turning = [a for a in range(2) if kind[a] in AT_A_JOINT and at[a] == joints[2]]
        pushing = [
            a
            for a in range(2)
            if kind[a] == _AT_SITE
            and m.site_bodyid[at[a]] == b
            and np.allclose(m.site_quat[at[a]], [1, 0, 0, 0], atol=1e-9)
            and np.flatnonzero(gear[a]).tolist() == [0]
        ]
        if len(turning) != 1 or len(pushing) != 1:
            wanted = "needs one actuator along its heading (at a site) and one on its hinge"
            raise UnsupportedEnvError(f"body {body!r} {wanted}")
        self.drive_index, self.turn_index = pushing[0], turning[0]


def heading_drive(plant: MujocoPlant, body: str) -> HeadingDrive:
    """The constants of a planar robot from a plant's model.

    Raises:
        UnsupportedEnvError: The model is not such a robot; the message says why.
    """
    m = plant.model
    frame = PlanarFrame(plant, body)
    b = plant.named("body", body)
    dofs = [int(m.jnt_dofadr[j]) for j in frame.joints]
    damping = m.dof_damping[dofs]
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, m.body_iquat[b])
    about_com = float(axes[6:] ** 2 @ m.body_inertia[b])
    mass, com = float(m.body_mass[b]), m.body_ipos[b]
    a, t = frame.drive_index, frame.turn_index
    fixed = int(mujoco.mjtGain.mjGAIN_FIXED)
    problems = {
        "the slides need equal damping above zero": damping[0] != damping[1] or damping[0] <= 0.0,
        "the hinge needs damping above zero": not m.dof_damping[dofs[2]] > 0.0,
        "the centre of mass must lie on the heading": abs(float(com[1])) > 1e-9,
        "the joints must have no armature or stiffness": m.dof_armature[dofs].any()
        or m.jnt_stiffness[frame.joints].any(),
        "the drive must be a plain motor": m.actuator_gaintype[a] != fixed
        or m.actuator_biastype[a] != int(mujoco.mjtBias.mjBIAS_NONE),
        "the turning actuator must be a speed servo": m.actuator_gaintype[t] != fixed
        or m.actuator_biastype[t] != int(mujoco.mjtBias.mjBIAS_AFFINE)
        or m.actuator_biasprm[t, 2] >= 0.0
        or m.actuator_biasprm[t, :2].any(),
        "the integrator must be Euler": m.opt.integrator != int(mujoco.mjtIntegrator.mjINT_EULER),
    }
    for expectation, broken in problems.items():
        if broken:
            raise UnsupportedEnvError(f"body {body!r} is no heading drive: {expectation}. Use Clearance.")
    gear, turn_gear = float(m.actuator_gear[a, 0]), float(m.actuator_gear[t, 0])
    gain, turn_gain = float(m.actuator_gainprm[a, 0]), float(m.actuator_gainprm[t, 0])
    yaw_clamp = float(m.actuator_forcerange[t, 1]) if m.actuator_forcelimited[t] else math.inf
    return HeadingDrive(
        mass=mass,
        damping=float(damping[0]),
        com_offset=float(com[0]),
        yaw_inertia=about_com + mass * float(com[0]) ** 2,
        yaw_damping=float(m.dof_damping[dofs[2]]),
        drive_gain=gear * gain,
        drive_limit=gear * _force_limit(m, a, gain),
        yaw_gain=turn_gear * turn_gain,
        yaw_feedback=turn_gear**2 * float(m.actuator_biasprm[t, 2]),
        yaw_limit=turn_gear * yaw_clamp,
        timestep=float(m.opt.timestep),
        substeps=plant.substeps,
    )


def _force_limit(m: mujoco.MjModel, actuator: int, gain: float) -> float:
    """The largest force in both directions: the control range times the gain, within the forcerange."""
    by_control = gain * float(min(-m.actuator_ctrlrange[actuator, 0], m.actuator_ctrlrange[actuator, 1]))
    if not m.actuator_forcelimited[actuator]:
        return by_control
    low, high = m.actuator_forcerange[actuator]
    return min(by_control, float(-low), float(high))
