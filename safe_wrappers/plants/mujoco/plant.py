"""MujocoPlant: f and g of any env whose unwrapped env has `.model` and `.data`.

The plant owns a copy of the model and its own data. It never writes to the env's, and its model may be changed
to be wrong on purpose (`plant.perturb(mass=1.2)`).
"""

import copy
from collections import deque
from collections.abc import Iterator
from fnmatch import fnmatchcase
from typing import Any, ClassVar

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.errors import ConfigurationError, UnknownNameError, UnsupportedEnvError
from safe_wrappers.plants.env_checks import (
    check_delay,
    check_timing,
    name_of,
    read_attribute,
    refuse_changed_actions,
    refuse_second_env,
    seconds,
)
from safe_wrappers.plants.mujoco.actuators import AffineActuators
from safe_wrappers.plants.mujoco.contact_forecast import ContactForecast, ContactReader, forecast_contacts
from safe_wrappers.plants.mujoco.displacement_step import moves_by_displacement
from safe_wrappers.plants.mujoco.fixed_bodies import fixed_bodies
from safe_wrappers.plants.mujoco.forecast import Forecast, Poses, Recorder
from safe_wrappers.plants.plant import Plant

Array = NDArray[np.float64]

_STATE = mujoco.mjtState.mjSTATE_INTEGRATION
_FREE, _BALL = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)
_LAST_INTEGRATOR = int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
_QUADRATIC = int(mujoco.mjtConstraintState.mjCNSTRSTATE_QUADRATIC)


class MujocoPlant(Plant):
    """`x = (qpos, qvel)`, `x' = f + g u`, through the actuators and the active constraints.

    The drift and the control matrix hold at the present set of active contacts and limits; a contact that
    opens or closes within the hold changes them. They are exact for pyramidal friction cones.

    Args:
        model: The filter's model; None copies the env's. Pass another (other masses) to test mismatch.
        delay_s: Evidence age plus detection plus actuation delay in s; the state is predicted over it with
            the commands in flight, on this plant's model.

    Raises:
        UnsupportedEnvError: The env has no MuJoCo model, an actuator that is not affine, or an action space
            that is not its model's control range.
    """

    bounds_are_action_space: ClassVar[bool] = True
    can_brake: ClassVar[bool] = True

    def __init__(self, model: mujoco.MjModel | None = None, delay_s: float = 0.0) -> None:
        self._given = model
        self.delay_s = seconds("delay_s", delay_s)
        self._pending: deque[Array] = deque()
        self._factors = (1.0, 1.0)
        self._raw: Any = None
        self.stamp = self.revision = 0

    def bind(self, env: gym.Env[Any, Any]) -> None:
        """Attach to an env and copy its model."""
        raw: Any = env.unwrapped
        refuse_second_env(self._raw, env)
        if not isinstance(getattr(raw, "model", None), mujoco.MjModel) or not hasattr(raw, "data"):
            raise UnsupportedEnvError(
                f"{raw} has no MuJoCo .model and .data; describe it with "
                "AnalyticPlant(f=..., g=..., state=...) instead"
            )
        self._raw = raw
        self._env = env
        self.model: mujoco.MjModel = copy.copy(self._given if self._given is not None else raw.model)
        if (self.model.nq, self.model.nv, self.model.nu) != (raw.model.nq, raw.model.nv, raw.model.nu):
            raise ConfigurationError(
                "the plant's model must have the env's joints and actuators: expected (nq, nv, nu) = "
                f"{(raw.model.nq, raw.model.nv, raw.model.nu)}, "
                f"got {(self.model.nq, self.model.nv, self.model.nu)}"
            )
        expected, timestep = raw.model.opt.timestep, self.model.opt.timestep
        if not np.isclose(timestep, expected, rtol=1e-9):
            raise ConfigurationError(
                f"the plant's model must take the env's physics steps: expected a timestep of {expected} s, "
                f"got {timestep} s"
            )
        if self.model.opt.integrator > _LAST_INTEGRATOR:
            raise UnsupportedEnvError(
                "the model's integrator is 'discrete' (MuJoCo 3.13 and later), whose accelerations are those of a "
                "whole step, which MujocoPlant's g is not; it handles: Euler, RK4, implicit, implicitfast. Use "
                "AnalyticPlant with your own f and g."
            )
        self.data = mujoco.MjData(self.model)
        self._nq, self._nv = int(self.model.nq), int(self.model.nv)
        self.actuators = AffineActuators(self.model)
        self._clamped = bool(self.model.actuator_forcelimited.any())
        limited = self.model.actuator_ctrllimited.astype(bool)
        self._lower = np.where(limited, self.model.actuator_ctrlrange[:, 0], -np.inf)
        self._upper = np.where(limited, self.model.actuator_ctrlrange[:, 1], np.inf)
        refuse_changed_actions(env)
        self._check_action_space(env)
        self.substeps = physics_steps(raw)
        self.hold_s = check_timing(env, control_interval(raw))
        check_delay(self.delay_s)
        self._delay_steps = int(np.ceil(self.delay_s / self.model.opt.timestep - 1e-9))
        self._pending = deque(maxlen=max(1, -(-self._delay_steps // self.substeps)))
        self._recorder = self._new_recorder()
        self._forecasts: dict[bytes, Forecast] = {}
        self._contact_forecasts: dict[bytes, ContactForecast] = {}
        self._contact_reader = ContactReader(self.model)
        self._snapshot = np.zeros(mujoco.mj_stateSize(self.model, int(_STATE)))
        self._loaded = self._forwarded = False
        if self._factors != (1.0, 1.0):
            self.perturb(*self._factors)

    def _new_recorder(self) -> Recorder:
        return Recorder(self.model, self.substeps)

    def _check_action_space(self, env: gym.Env[Any, Any]) -> None:
        space = env.action_space
        assert isinstance(space, gym.spaces.Box)  # the filter has refused every other space
        limited = self.model.actuator_ctrllimited.astype(bool)
        rounding = 0.5e-6 * (self._upper - self._lower)[limited]
        fits = space.shape == (self.model.nu,) and (
            np.allclose(space.low[limited], self._lower[limited], atol=rounding)
            and np.allclose(space.high[limited], self._upper[limited], atol=rounding)
        )
        if fits:
            return
        ranges = f"the action space is {space}, the model's control range {self._lower} to {self._upper}"
        if space != env.unwrapped.action_space:
            raise UnsupportedEnvError(
                f"a wrapper of {name_of(env)} changes its action space; the filter must be inside of that wrapper: "
                + ranges
            )
        if moves_by_displacement(env.unwrapped):
            raise UnsupportedEnvError(
                f"{name_of(env)} moves its gripper by displacements: take DisplacementPlant(), or leave plant out"
            )
        raise UnsupportedEnvError(
            f"{name_of(env)} rescales or limits actions in its own step; filters on such an env are not supported "
            f"yet, except with an AnalyticPlant(f=..., g=..., state=...) of your own: {ranges}"
        )

    def perturb(self, mass: float = 1.0, damping: float = 1.0) -> None:
        """Scale the masses (and inertias) and joint damping of the plant's own model, now or once it has one."""
        if not (mass > 0.0 and damping >= 0.0):
            raise ConfigurationError(f"factors must be positive, got mass={mass}, damping={damping}")
        if self._raw is None:
            self._factors = (self._factors[0] * mass, self._factors[1] * damping)
            return
        self.revision += 1
        self.model.body_mass *= mass
        self.model.body_inertia *= mass
        self.model.dof_damping *= damping
        mujoco.mj_setConst(self.model, self.data)
        self._recorder = self._new_recorder()  # its braking depends on the masses
        self._loaded = self._forwarded = False
        self._forecasts.clear()
        self._contact_forecasts.clear()

    def observe(self) -> None:
        """Take the env's present state; nothing is computed until it is asked for."""
        mujoco.mj_getState(self._raw.model, self._raw.data, self._snapshot, int(_STATE))
        self._loaded = self._forwarded = False
        self._forecasts.clear()
        self._contact_forecasts.clear()
        self.stamp += 1
        # MuJoCo resets a state that is not a number, which a prediction would hide.
        if self._delay_steps and bool(np.isfinite(self._snapshot).all()):
            self._predict_over_delay()

    def executed(self, control: Array | None) -> None:
        """Remember a sent command for the delay."""
        if control is None:
            self._pending.clear()
        elif self._delay_steps:
            self._pending.append(np.array(control))

    def _predict_over_delay(self) -> None:
        self._load()
        # The oldest command has acted in part already; before the first one the env's own control acts.
        early = self._delay_steps - self.substeps * len(self._pending)
        if early > 0:
            mujoco.mj_step(self.model, self.data, early)
        for i, control in enumerate(self._pending):
            self.data.ctrl[:] = control
            mujoco.mj_step(self.model, self.data, self.substeps + (min(early, 0) if i == 0 else 0))
        self._keep()

    def _keep(self) -> None:
        """Take the data's state as the present one."""
        mujoco.mj_getState(self.model, self.data, self._snapshot, int(_STATE))
        self._loaded = False

    def _load(self) -> None:
        if not self._loaded:
            mujoco.mj_setState(self.model, self.data, self._snapshot, int(_STATE))
            self._loaded, self._forwarded = True, False

    def _load_to_step(self) -> None:
        """The data at the present state, about to leave it."""
        self._load()
        self._loaded = False

    def forward(self) -> mujoco.MjData:
        """The plant's data with every derived quantity up to date at the present state.

        MuJoCo's own `data.xpos` and `data.xvel` lag one substep behind `qpos` after a step; these do not.
        """
        self._load()
        if not self._forwarded:
            if self.model.nu:
                self.data.ctrl[:] = self._reference()
            mujoco.mj_forward(self.model, self.data)
            self._derive()
            self._forwarded = True
        return self.data

    def _reference(self) -> Array:
        """The control about which contact forces are linearised: zero, or the nearest the actuator has."""
        return np.asarray(np.clip(0.0, self._lower, self._upper))

    def _derive(self) -> None:
        d = self.data
        gain, _ = self.actuators.gain_and_bias(d.actuator_length, d.actuator_velocity)
        least, most = self.actuators.acting_range(d.actuator_length, d.actuator_velocity)
        moment = self.actuators.moment(d)
        force_per_control = moment * gain[:, None]
        saturated = most <= least
        effect = self._solve_inertia(force_per_control).T
        self._effect = np.where(saturated, 0.0, effect)
        self._drift = d.qacc - self._effect @ np.where(saturated, 0.0, np.clip(d.ctrl, least, most))

    def _solve_inertia(self, rows: Array) -> Array:
        """`rows @ inv(M + J_a' D_a J_a)`: accelerations per generalised force with the active constraints."""
        m, d = self.model, self.data
        out = np.zeros_like(rows)
        active = d.efc_state == _QUADRATIC if d.nefc else np.zeros(0, bool)
        if not active.any():
            mujoco.mj_solveM(m, d, out, np.ascontiguousarray(rows))
            return out
        jacobian = self._constraint_jacobian()[active]
        inertia = np.empty((m.nv, m.nv))
        for i, unit in enumerate(np.eye(m.nv)):
            mujoco.mj_mulM(m, d, inertia[i], unit)
        stiff = inertia + jacobian.T @ (d.efc_D[active][:, None] * jacobian)
        return np.asarray(np.linalg.solve(stiff, rows.T).T)

    def _constraint_jacobian(self) -> Array:
        m, d = self.model, self.data
        if not mujoco.mj_isSparse(m):
            return np.array(d.efc_J.reshape(d.nefc, m.nv))
        dense = np.zeros((d.nefc, m.nv))
        mujoco.mju_sparse2dense(dense, d.efc_J, d.efc_J_rownnz, d.efc_J_rowadr, d.efc_J_colind)
        return dense

    @property
    def time(self) -> float:
        """Of the present state, s; under a delay the predicted one."""
        return float(self._snapshot[0])

    @property
    def qpos(self) -> Array:
        """Positions, shape (nq,): m, rad, or quaternions."""
        return self._snapshot[1 : 1 + self._nq]

    @property
    def qvel(self) -> Array:
        """Velocities, shape (nv,): m/s or rad/s."""
        return self._snapshot[1 + self._nq : 1 + self._nq + self._nv]

    @property
    def state(self) -> Array:
        """(qpos, qvel), shape (nq + nv,)."""
        return self._snapshot[1 : 1 + self._nq + self._nv]

    @property
    def f(self) -> Array:
        """Drift of (qpos, qvel), shape (nq + nv,): at zero control, with bias forces and active constraints."""
        self.forward()
        return np.concatenate([self._position_rate(), self._drift])

    @property
    def g(self) -> Array:
        """Control matrix, shape (nq + nv, nu); positions do not respond at once."""
        self.forward()
        return np.vstack([np.zeros((self.model.nq, self.model.nu)), self._effect])

    @property
    def acceleration(self) -> tuple[Array, Array]:
        """`qacc = drift + effect @ u`: shapes (nv,) and (nv, nu)."""
        self.forward()
        return self._drift, self._effect

    def _position_rate(self) -> Array:
        if self.model.nq == self.model.nv:
            return self.qvel.copy()
        rate = np.zeros(self.model.nq)
        for j in range(self.model.njnt):
            q, v = int(self.model.jnt_qposadr[j]), int(self.model.jnt_dofadr[j])
            kind = self.model.jnt_type[j]
            if kind == _FREE:
                rate[q : q + 3] = self.qvel[v : v + 3]
                q, v = q + 3, v + 3
            if kind in (_FREE, _BALL):
                # Angular velocities of these joints are in the body's frame; mju_derivQuat wants the world's.
                turn = np.zeros(4)
                mujoco.mju_mulQuatAxis(turn, self.qpos[q : q + 4].copy(), self.qvel[v : v + 3].copy())
                rate[q : q + 4] = 0.5 * turn
            else:
                rate[q] = self.qvel[v]
        return rate

    @property
    def lower(self) -> Array:
        """Smallest control, shape (nu,): ctrlrange, or -inf."""
        return self._lower

    @property
    def upper(self) -> Array:
        """Largest control, shape (nu,): ctrlrange, or inf."""
        return self._upper

    @property
    def acting_range(self) -> tuple[Array, Array]:
        """The controls between which the force still changes at some time of the hold, shapes (nu,).

        Narrower than the bounds where a forcerange clamps; beyond it f + g u is not the machine.
        """
        if not self._clamped:
            return self._lower, self._upper
        motion = self.actuators.motion_without_kinematics(self.qpos, self.qvel)
        if motion is None:
            data = self.forward()
            motion = data.actuator_length, data.actuator_velocity
        return self.actuators.acting_range(*motion, self.hold_s)

    def inertia_diagonal(self) -> Array:
        """Diagonal of the joint-space inertia, shape (nv,), kg or kg m^2."""
        self.forward()
        diagonal, column = np.empty(self.model.nv), np.empty(self.model.nv)
        for i, unit in enumerate(np.eye(self.model.nv)):
            mujoco.mj_mulM(self.model, self.data, column, unit)
            diagonal[i] = column[i]
        return diagonal

    def rollout(self, control: Array) -> Iterator[mujoco.MjData]:
        """Hold a control for one control interval on the plant's own model, substep by substep.

        Yields the plant's data after each physics substep (positions and velocities are new, derived
        quantities lag as MuJoCo leaves them). The present state is restored for the next question.
        """
        self._load_to_step()
        self._recorder.act(self.data, control)
        for left in range(self.substeps - 1, -1, -1):
            mujoco.mj_step(self.model, self.data)
            if left == 0:
                self._recorder.settle(self.data)
            yield self.data

    def forecast(self, control: Array, holds: int = 1) -> Forecast:
        """What a control leads to: held for one control interval, then the actuated joints are braked.

        Kept until the next observation, so that constraints that ask about one control share one forecast.

        Args:
            control: Shape (nu,).
            holds: Control intervals to look ahead, >= 1. In those after the first every actuator opposes its
                own motion (`Recorder`), which is one way to go on, not the best one.
        """
        key = control.tobytes()
        known = self._forecasts.get(key)
        if known is None or len(known.published_frames) < holds:
            self._load_to_step()
            known = self._forecasts[key] = self._recorder.record(self.data, control, holds)
        return known.first(holds)

    def contact_forecast(self, control: Array) -> ContactForecast:
        """The contacts with the fixed world while a control is held for one control interval, shape (nu,).

        Kept until the next observation.
        """
        key = control.tobytes()
        if key not in self._contact_forecasts:
            self._load_to_step()
            self._recorder.act(self.data, control)
            self._contact_forecasts[key] = forecast_contacts(
                self.model, self.data, self.substeps, self._contact_reader
            )
        return self._contact_forecasts[key]

    def under(self, control: Array) -> mujoco.MjData:
        """The plant's data with every derived quantity at the present state under a control, shape (nu,)."""
        self._load_to_step()
        self._recorder.act(self.data, control)
        mujoco.mj_forward(self.model, self.data)
        return self.data

    @property
    def weight_n(self) -> float:
        """Of everything that moves, N; without gravity its mass in kg."""
        moving = ~fixed_bodies(self.model)
        gravity = float(np.linalg.norm(self.model.opt.gravity))
        return float(self.model.body_mass[moving].sum()) * (gravity or 1.0)

    def braking(self) -> Array:
        """The control with which a forecast goes on after its held control, shape (nu,), from the present state."""
        return self._recorder.braking(self.forward())

    def pose(self) -> mujoco.MjData:
        """The plant's data with positions of bodies up to date at the present state; cheaper than `forward`."""
        self._load()  # a forecast leaves the data at its end
        if not self._forwarded:
            mujoco.mj_kinematics(self.model, self.data)
        return self.data

    def substep_ago(self) -> Poses:
        """Poses one physics substep before the present state, by its velocities; exact after an Euler step."""
        self._load()
        self._recorder.place(self.data)
        before = self.qpos.copy()
        mujoco.mj_integratePos(self.model, before, self.qvel, -self.model.opt.timestep)
        return self._recorder.poses(before[None])

    def published(self) -> mujoco.MjData | None:
        """The env's own data, to read what it publishes; None under a delay, when the present is predicted.

        After a step `data.xpos` and what depends on it belong to the last point that the integrator evaluated.
        """
        data: mujoco.MjData = self._raw.data
        return None if self._delay_steps else data

    def path(self, control: Array) -> list[Array]:
        """The states (qpos, qvel) after each physics substep of a held control."""
        return [np.concatenate([data.qpos, data.qvel]) for data in self.rollout(control)]

    def motion(self, kind: str, name: str) -> tuple[Array, Array]:
        """Position and velocity of a named frame's origin, as `point` has them; without accelerations much cheaper.

        Args:
            kind: "body", "site" or "geom".
            name: Its name in the model.

        Returns:
            p (3,) in m, v (3,) in m/s.
        """
        m, d = self.model, self.pose()
        if not self._forwarded:
            mujoco.mj_comPos(m, d)  # the Jacobian's points of reference
        body, p = self._frame(d, kind, name)
        jac = np.zeros((3, m.nv))
        mujoco.mj_jac(m, d, jac, None, p, body)
        return p.copy(), jac @ self.qvel

    def _frame(self, data: mujoco.MjData, kind: str, name: str) -> tuple[int, Array]:
        """The body that carries a named frame, and the frame's origin."""
        handle = self.named(kind, name)
        body = handle if kind == "body" else int(getattr(self.model, f"{kind}_bodyid")[handle])
        return body, getattr(data, {"body": "xpos", "site": "site_xpos", "geom": "geom_xpos"}[kind])[handle]

    def point(self, kind: str, name: str) -> tuple[Array, Array, Array, Array]:
        """Motion of a named frame's origin: position, velocity, drift and control matrix of its acceleration.

        Args:
            kind: "body", "site" or "geom".
            name: Its name in the model.

        Returns:
            p (3,) in m, v (3,) in m/s, a0 (3,) in m/s^2 and A (3, nu): `acceleration = a0 + A @ u`.
        """
        m, d = self.model, self.forward()
        body, p = self._frame(d, kind, name)
        jac, jac_dot = np.zeros((3, m.nv)), np.zeros((3, m.nv))
        mujoco.mj_jac(m, d, jac, None, p, body)
        mujoco.mj_jacDot(m, d, jac_dot, None, p, body)
        drift, effect = self._drift, self._effect
        return p.copy(), jac @ self.qvel, jac @ drift + jac_dot @ self.qvel, jac @ effect

    def named(self, kind: str, name: str) -> int:
        """The id of a body, site, geom, joint or actuator; an unknown name is refused with the list."""
        found = mujoco.mj_name2id(self.model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), name)
        if found < 0:
            raise UnknownNameError(f"the model has no {kind} {name!r}; it has: {', '.join(self.names(kind))}")
        return int(found)

    def names(self, kind: str, pattern: str = "*") -> list[str]:
        """All names of a kind that match a shell pattern."""
        count = {"body": "nbody", "joint": "njnt", "actuator": "nu"}.get(kind, f"n{kind}")
        every = (getattr(self.model, kind)(i).name for i in range(getattr(self.model, count)))
        return [n for n in every if n and fnmatchcase(n, pattern)]

    def attribute(self, name: str) -> Any:
        """Read a published fact of the env."""
        found = getattr(self._raw, name, None)
        return found if found is not None else read_attribute(self._env, name)


def require_mujoco(plant: Plant, message: str) -> MujocoPlant:
    """The plant, if it is a MujocoPlant; else an UnsupportedEnvError with the message."""
    if not isinstance(plant, MujocoPlant):
        raise UnsupportedEnvError(message)
    return plant


def control_interval(raw: Any) -> float:
    """How long an unwrapped MuJoCo env holds one action, s."""
    return physics_steps(raw) * float(raw.model.opt.timestep)


def physics_steps(raw: Any) -> int:
    """How many physics substeps an unwrapped MuJoCo env takes with one action."""
    env = _stepped(raw)
    named = getattr(env, "frame_skip", getattr(env, "n_substeps", None))
    if named is not None:
        return int(named)
    if not hasattr(env, "dt"):
        raise UnsupportedEnvError(
            f"{raw} does not say how long a step lasts: give it an attribute dt (s) or frame_skip (physics steps)"
        )
    return round(float(env.dt) / float(raw.model.opt.timestep))


def _stepped(raw: Any) -> Any:
    """The env that steps the physics: this one, or one that it holds over the same data (a maze holds its robot)."""
    if hasattr(raw, "frame_skip"):
        return raw
    held = (e for e in vars(raw).values() if isinstance(e, gym.Env) and getattr(e, "data", None) is raw.data)
    return next(held, raw)
