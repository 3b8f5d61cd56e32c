"""rigid_model_check: whether a machine with springs between motors and links may be taken as rigid."""

from dataclasses import dataclass
from typing import Any, Final

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.control.bandwidth import modes
from safe_wrappers.plants.mujoco import model as of_model
from safe_wrappers.plants.mujoco.plant import MujocoPlant

LEFT_OVER: Final = 0.05
"""Share of a vibration's amplitude that may be left after a control interval for a rigid model to be good enough."""


@dataclass(frozen=True)
class RigidModelCheck:
    """What `rigid_model_check` found; printed, it is the verdict.

    Attributes:
        springs: Names of the joints that are springs behind a motor; empty if there are none.
        resonances: Of the springs, at the pose of the check, the slowest first, rad/s.
        damping_ratios: Of each of them, to first order in the damping.
        boundary_layer_s: Time constant with which the slowest of the vibrations decays, 1 / (ratio resonance), s;
            infinite without damping, 0 without springs.
        control_dt: Control interval of the env, s.
    """

    springs: tuple[str, ...]
    resonances: tuple[float, ...]
    damping_ratios: tuple[float, ...]
    boundary_layer_s: float
    control_dt: float

    @property
    def left_over(self) -> float:
        """Share of a vibration's amplitude that is left after one control interval."""
        return float(np.exp(-self.control_dt / self.boundary_layer_s)) if self.boundary_layer_s > 0.0 else 0.0

    @property
    def rigid_is_good_enough(self) -> bool:
        """Whether every vibration is gone, but for 5 %, before the next command comes."""
        return self.left_over <= LEFT_OVER

    def __str__(self) -> str:
        """The verdict and why, in one sentence."""
        if not self.springs:
            return "rigid model is good enough: no spring lies behind a motor"
        rings = ", ".join(
            f"{w / (2.0 * np.pi):.3g} Hz (damping ratio {z:.2g})"
            for w, z in zip(self.resonances, self.damping_ratios, strict=True)
        )
        verdict = "good enough" if self.rigid_is_good_enough else "not good enough"
        return (
            f"rigid model is {verdict}: {rings}; the slowest decay takes {self.boundary_layer_s:.3g} s, and "
            f"{self.left_over:.0%} of the amplitude is left after a control interval of {self.control_dt:.3g} s"
        )


def rigid_model_check(env: gym.Env[Any, Any], plant: MujocoPlant | None = None) -> RigidModelCheck:
    """Whether a rigid model of a MuJoCo env is good enough, by its springs' vibrations at the present pose.

    A spring is a hinge or slide with stiffness that no actuator drives, with a driven joint before it on the way from
    the world. Inertia, stiffness and damping are linearised; servos on the motors count, gravity, contacts and joint
    limits do not.
    The appendix: below the slowest vibration's time scale the rigid manifold holds; a vibration that is not gone when
    the next command comes is excited again and again.

    Args:
        env: Any with a MuJoCo model, after a reset or in the pose to be checked.
        plant: A `MujocoPlant` that says where model and data are, bound to this env or to none; None: a new one.

    Raises:
        UnsupportedEnvError: No MuJoCo model, or one that `MujocoPlant` does not handle.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> print(sw.plants.rigid_model_check(gym.make("FlexJointReach-v0")))  # doctest: +ELLIPSIS
        rigid model is not good enough: 10.1 Hz (damping ratio ...
    """
    plant = MujocoPlant() if plant is None else plant
    plant.bind(env)
    plant.observe()
    data, model = plant.forward(), plant.model
    moment = plant.actuators.moment(data)
    springs = _springs(model, np.abs(moment).max(axis=0, initial=0.0) > 0.0)
    dofs = model.jnt_dofadr[springs]
    if not len(springs):
        return RigidModelCheck((), (), (), 0.0, plant.control_dt)
    stiffness, damping = np.zeros((model.nv, model.nv)), np.diag(model.dof_damping)
    scalar = np.isin(model.jnt_type, of_model.SCALAR_JOINTS)
    every = model.jnt_dofadr[scalar]
    stiffness[every, every] = model.jnt_stiffness[scalar]
    affine = (model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_AFFINE))[: len(moment)]
    fed_back = -model.actuator_biasprm[: len(moment)] * affine[:, None]
    stiffness += moment.T * fed_back[:, 1] @ moment
    damping = damping + moment.T * fed_back[:, 2] @ moment
    found = modes(of_model.inertia(model, data), stiffness, damping)
    stored = found.resonances**2
    own = (found.shapes[dofs] ** 2 * model.jnt_stiffness[springs][:, None]).sum(axis=0)
    chosen = np.flatnonzero((found.resonances > 0.0) & (own > 0.5 * stored))
    resonances, ratios = found.resonances[chosen], found.damping_ratios[chosen]
    slowest = float((resonances * ratios).min(initial=np.inf))
    return RigidModelCheck(
        tuple(model.joint(int(j)).name or f"#{j}" for j in springs),
        tuple(resonances.tolist()),
        tuple(ratios.tolist()),
        1.0 / slowest if slowest > 0.0 else np.inf,
        plant.control_dt,
    )


def _springs(model: mujoco.MjModel, driven: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Joints with stiffness that no actuator drives and that have a driven joint before them, shape (n,)."""
    found = []
    for j in np.flatnonzero(np.isin(model.jnt_type, of_model.SCALAR_JOINTS) & (model.jnt_stiffness > 0.0)):
        dof = int(model.jnt_dofadr[j])
        before = int(model.dof_parentid[dof])
        while before >= 0 and not driven[before]:
            before = int(model.dof_parentid[before])
        if not driven[dof] and before >= 0:
            found.append(j)
    return np.array(found, dtype=np.intp)
