"""MujocoPlant: f and g of any env whose unwrapped env has `.model` and `.data`.

The plant owns a copy of the model and its own data. It never writes to the env's, and its model may be changed
to be wrong on purpose (`plant.perturb(mass=1.2)`).
"""

from collections import deque
from collections.abc import Iterator
from typing import Any, ClassVar

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.plants.env_checks import (
    check_delay,
    check_timing,
    read_attribute,
    refuse_changed_actions,
    refuse_second_env,
    seconds,
)
from safe_wrappers.plants.mujoco.actuators import AffineActuators
from safe_wrappers.plants.mujoco.binding import check_action_space, control_range, own_model
from safe_wrappers.plants.mujoco.contact_forecast import ContactForecast, ContactReader, forecast_contacts
from safe_wrappers.plants.mujoco.fixed_bodies import fixed_bodies
from safe_wrappers.plants.mujoco.forecast import Forecast, Poses, Recorder
from safe_wrappers.plants.mujoco.linear_model import drift_and_effect, inertia_diagonal, position_rate
from safe_wrappers.plants.mujoco.named import frame, named, names
from safe_wrappers.plants.mujoco.shared_step import SharedStep, can_share
from safe_wrappers.plants.mujoco.state import MujocoState
from safe_wrappers.plants.mujoco.timing import control_interval, physics_steps
from safe_wrappers.plants.plant import Plant

Array = NDArray[np.float64]


class MujocoPlant(MujocoState):
    """`x = (qpos, qvel)`, `x' = f + g u`, through the actuators and the active constraints.

    The drift and the control matrix hold at the present set of active contacts and limits; a contact that
    opens or closes within the hold changes them. They are exact for pyramidal friction cones.

    Args:
        model: The filter's model; None copies the env's. Pass another (other masses) to test mismatch.
        delay_s: Evidence age plus detection plus actuation delay in s; the state is predicted over it with
            the commands in flight, on this plant's model.
        share_step: Let the rollout of the executed control be the env's step, which saves simulating it twice. None:
            with envs where that was measured equal bit for bit (Gymnasium's MuJoCo envs and ours on velocity);
            True: with any env that does not override `MujocoEnv`'s simulation step and leaves its model alone.

    Raises:
        UnsupportedEnvError: The env has no MuJoCo model, an actuator that is not affine, or an action space
            that is not its model's control range.
    """

    bounds_are_action_space: ClassVar[bool] = True
    can_brake: ClassVar[bool] = True

    def __init__(
        self, model: mujoco.MjModel | None = None, delay_s: float = 0.0, share_step: bool | None = None
    ) -> None:
        self._given, self._share_step = model, share_step
        self.delay_s = seconds("delay_s", delay_s)
        self._pending = deque()
        self._factors = (1.0, 1.0)
        self._raw = None
        self.observation_id = self.model_version = 0

    def bind(self, env: gym.Env[Any, Any]) -> None:
        """Attach to an env and copy its model."""
        raw: Any = env.unwrapped
        refuse_second_env(self._raw, env)
        self.model = own_model(raw, self._given)
        self._raw, self._env = raw, env
        self.data = mujoco.MjData(self.model)
        self._shared: SharedStep | None = None
        self.actuators = AffineActuators(self.model)
        self._clamped = bool(self.model.actuator_forcelimited.any())
        self._lower, self._upper = control_range(self.model)
        refuse_changed_actions(env)
        self._check_action_space(env)
        self.substeps = physics_steps(raw)
        self.control_dt = check_timing(env, control_interval(raw))
        check_delay(self.delay_s)
        self._start()
        self._recorder = self._new_recorder()
        if self._may_share(env):
            self._shared = SharedStep(raw, self.substeps)
        self._contact_reader = ContactReader(self.model)
        if self._factors != (1.0, 1.0):
            self.perturb(*self._factors)

    def _may_share(self, env: gym.Env[Any, Any]) -> bool:
        """Whether rollouts are the env's own steps: its model, its state now, and a step that is known."""
        exact = self._given is None and not self.delay_s
        if self._share_step and not (exact and can_share(env, known_only=False)):
            raise ConfigurationError(
                "share_step=True needs the env's own model, no delay, and an env that steps as Gymnasium's MujocoEnv "
                f"does; {env.unwrapped} with model={self._given!r} and delay_s={self.delay_s} is none: leave it out"
            )
        return self._share_step is not False and exact and can_share(env, known_only=not self._share_step)

    @property
    def shared_steps(self) -> int:
        """Env steps that were taken over from a rollout since binding."""
        return 0 if self._shared is None else self._shared.count

    def step(self, env: gym.Env[Any, Any], action: Any) -> Any:
        """Step the env; what a rollout of the same controls has simulated already is not simulated again."""
        if self._shared is None:
            return env.step(action)
        return self._shared.step(env, action, self._recorder, self._snapshot)

    def _new_recorder(self) -> Recorder:
        return Recorder(self.model, self.substeps)

    def _check_action_space(self, env: gym.Env[Any, Any]) -> None:
        check_action_space(env, self._lower, self._upper)

    def perturb(self, mass: float = 1.0, damping: float = 1.0) -> None:
        """Scale the masses (and inertias) and joint damping of the plant's own model, now or once it has one."""
        if not (mass > 0.0 and damping >= 0.0):
            raise ConfigurationError(f"factors must be positive, got mass={mass}, damping={damping}")
        if self._raw is None:
            self._factors = (self._factors[0] * mass, self._factors[1] * damping)
            return
        self.model_version += 1
        self._shared = None
        self.model.body_mass *= mass
        self.model.body_inertia *= mass
        self.model.dof_damping *= damping
        mujoco.mj_setConst(self.model, self.data)
        self._recorder = self._new_recorder()  # its braking depends on the masses
        self._loaded = self._forwarded = False
        self._forecasts.clear()
        self._contact_forecasts.clear()

    def forward(self) -> mujoco.MjData:
        """The plant's data with every derived quantity up to date at the present state.

        MuJoCo's own `data.xpos` and `data.xvel` lag one substep behind `qpos` after a step; these do not.
        """
        self._load()
        if not self._forwarded:
            if self.model.nu:
                self.data.ctrl[:] = self._reference()
            mujoco.mj_forward(self.model, self.data)
            self._drift, self._effect = drift_and_effect(self.model, self.data, self.actuators)
            self._forwarded = True
        return self.data

    def _reference(self) -> Array:
        """The control about which contact forces are linearised: zero, or the nearest the actuator has."""
        return np.asarray(np.clip(0.0, self._lower, self._upper))

    @property
    def f(self) -> Array:
        """Drift of (qpos, qvel), shape (nq + nv,): at zero control, with bias forces and active constraints."""
        self.forward()
        return np.concatenate([position_rate(self.model, self.qpos, self.qvel), self._drift])

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
        return self.actuators.acting_range(*motion, self.control_dt)

    def inertia_diagonal(self) -> Array:
        """Diagonal of the joint-space inertia, shape (nv,), kg or kg m^2."""
        return inertia_diagonal(self.model, self.forward())

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

    def forecast(self, control: Array, horizon: int = 1) -> Forecast:
        """What a control leads to: held for one control interval, then the actuated joints are braked.

        Kept until the next observation, so that constraints that ask about one control share one forecast.

        Args:
            control: Shape (nu,).
            horizon: Control intervals to look ahead, >= 1. In those after the first every actuator opposes its
                own motion (`Recorder`), which is one way to go on, not the best one.
        """
        key = control.tobytes()
        known = self._forecasts.get(key)
        if known is None or len(known.published_frames) < horizon:
            first = known.first(1) if known is not None and self._recorder.held_control == key else None
            if first is None:
                self._load_to_step()
            self._loaded = False
            known = self._forecasts[key] = self._recorder.record(self.data, control, horizon, first)
        return known.first(horizon)

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
        body, p = frame(m, d, kind, name)
        jac = np.zeros((3, m.nv))
        mujoco.mj_jac(m, d, jac, None, p, body)
        return p.copy(), jac @ self.qvel

    def point(self, kind: str, name: str) -> tuple[Array, Array, Array, Array]:
        """Motion of a named frame's origin: position, velocity, drift and control matrix of its acceleration.

        Args:
            kind: "body", "site" or "geom".
            name: Its name in the model.

        Returns:
            p (3,) in m, v (3,) in m/s, a0 (3,) in m/s^2 and A (3, nu): `acceleration = a0 + A @ u`.
        """
        m, d = self.model, self.forward()
        body, p = frame(m, d, kind, name)
        jac, jac_dot = np.zeros((3, m.nv)), np.zeros((3, m.nv))
        mujoco.mj_jac(m, d, jac, None, p, body)
        mujoco.mj_jacDot(m, d, jac_dot, None, p, body)
        drift, effect = self._drift, self._effect
        return p.copy(), jac @ self.qvel, jac @ drift + jac_dot @ self.qvel, jac @ effect

    def named(self, kind: str, name: str) -> int:
        """The id of a body, site, geom, joint or actuator; an unknown name is refused with the list."""
        return named(self.model, kind, name)

    def names(self, kind: str, pattern: str = "*") -> list[str]:
        """All names of a kind that match a shell pattern."""
        return names(self.model, kind, pattern)

    def attribute(self, name: str) -> Any:
        """Read a published fact of the env."""
        found = getattr(self._raw, name, None)
        return found if found is not None else read_attribute(self._env, name)


def require_mujoco(plant: Plant, message: str) -> MujocoPlant:
    """The plant, if it is a MujocoPlant; else an UnsupportedEnvError with the message."""
    if not isinstance(plant, MujocoPlant):
        raise UnsupportedEnvError(message)
    return plant
