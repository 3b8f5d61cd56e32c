"""MujocoPlant: f and g of any env whose unwrapped env has `.model` and `.data`, from a copy of the model."""

from collections import deque
from typing import Any, ClassVar

import gymnasium as gym
import mujoco
import numpy as np

from safe_wrappers.checks import Array, non_negative
from safe_wrappers.errors import ConfigurationError, UnsupportedEnvError
from safe_wrappers.plants import env_checks
from safe_wrappers.plants.mujoco import model as of_model
from safe_wrappers.plants.mujoco.actuators import AffineActuators, Response, point_motion
from safe_wrappers.plants.mujoco.binding import check_action_space, control_interval, own_model, physics_steps
from safe_wrappers.plants.mujoco.contacts import ContactForecast, ContactReader
from safe_wrappers.plants.mujoco.forecast import Forecast, Poses, Recorder
from safe_wrappers.plants.mujoco.shared_step import shared_step
from safe_wrappers.plants.plant import Plant

_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)


class MujocoPlant(Plant):
    """`x = (qpos, qvel)`, `x' = f + g u`, through the actuators and the active constraints.

    f and g hold for the present set of active contacts and limits, and are exact for pyramidal friction cones. The
    env's own model and data are only read.

    Args:
        model: The filter's model; None copies the env's. Pass another (other masses) to test mismatch.
        delay_s: Evidence age plus detection plus actuation delay in s, over which this plant's model predicts.
        share_step: Let the rollout of the executed control be the env's step. None: with envs where that was measured
            equal bit for bit; True: with any that keeps `MujocoEnv`'s simulation step and leaves its model alone.

    Raises:
        UnsupportedEnvError: No MuJoCo model, an actuator that is not affine, or actions that are not controls.
    """

    bounds_are_action_space: ClassVar[bool] = True
    can_brake: ClassVar[bool] = True
    lower: Array = np.zeros(0)  #: of the control, shape (nu,), once bound: ctrlrange, or -inf and inf
    upper: Array = np.zeros(0)

    def __init__(
        self, model: mujoco.MjModel | None = None, delay_s: float = 0.0, share_step: bool | None = None
    ) -> None:
        self._given, self._share_step = model, share_step
        self.delay_s = non_negative("delay_s", delay_s, "s")
        self._pending: deque[Array] = deque()
        self._factors = (1.0, 1.0)
        self._raw: Any = None

    def bind(self, env: gym.Env[Any, Any]) -> None:
        """Attach to an env and copy its model."""
        raw: Any = env.unwrapped
        env_checks.refuse_second_env(self._raw, env)
        self.model = own_model(raw, self._given)
        self._raw, self._env = raw, env
        self.data = mujoco.MjData(self.model)
        self.actuators = AffineActuators(self.model)
        self._response = Response(self.model, self.data, self.actuators)
        self._clamped = bool(self.model.actuator_forcelimited.any())
        self.lower, self.upper = of_model.control_range(self.model)
        env_checks.refuse_changed_actions(env)
        self._check_action_space(env)
        self._idle = np.clip(0.0, self.lower, self.upper)
        self.substeps = physics_steps(raw)
        self.control_dt = env_checks.check_timing(env, control_interval(raw))
        self._nq, self._nv = int(self.model.nq), int(self.model.nv)
        self.frames = of_model.Frames(self.model, self.data)
        self._delay_steps = int(np.ceil(self.delay_s / self.model.opt.timestep - 1e-9))
        self._pending = deque(maxlen=max(1, -(-self._delay_steps // self.substeps)))
        self._snapshot = np.zeros(mujoco.mj_stateSize(self.model, _STATE))
        self._recorder = self._new_recorder()
        self._forget()
        exact = self._given is None and not self.delay_s
        self._shared = shared_step(env, self.substeps, exact, self._share_step)
        self._contact_reader = ContactReader(self.model)
        if self._factors != (1.0, 1.0):
            self.perturb(*self._factors)

    @property
    def shared_steps(self) -> int:
        """Env steps that were taken over from a rollout since binding."""
        return 0 if self._shared is None else self._shared.count

    def offer_rollout(self) -> None:
        """What a rollout of the same controls has simulated already, the env need not simulate again."""
        if self._shared is not None:
            self._shared.offer(self._recorder, self._snapshot)

    def withdraw_rollout(self) -> None:
        """Leave the env as it was, if it has not used the rollout."""
        if self._shared is not None:
            self._shared.withdraw()

    def _new_recorder(self) -> Recorder:
        return Recorder(self.model, self.data, self.substeps)

    def _check_action_space(self, env: gym.Env[Any, Any]) -> None:
        check_action_space(env, self.lower, self.upper)

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
        self._forget()

    def _forget(self) -> None:
        """Called when the state or the model has changed."""
        self._loaded = self._forwarded = False
        self._affine: tuple[Array, Array] | None = None
        self._recorder.forget()
        self._forecasts: dict[tuple[bytes, bool], Forecast] = {}
        self._contact_forecasts: dict[bytes, ContactForecast] = {}

    def observe(self) -> None:
        """Take the env's present state; everything else is computed on demand."""
        mujoco.mj_getState(self._raw.model, self._raw.data, self._snapshot, _STATE)
        self._forget()
        self.observation_id += 1
        # MuJoCo resets a state with a NaN: a prediction would hide it.
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
        # The oldest command has already acted in part; before the first one the env's own control acts.
        early = self._delay_steps - self.substeps * len(self._pending)
        if early > 0:
            mujoco.mj_step(self.model, self.data, early)
        for i, control in enumerate(self._pending):
            self.data.ctrl[:] = control
            mujoco.mj_step(self.model, self.data, self.substeps + (min(early, 0) if i == 0 else 0))
        self._keep()

    def _keep(self) -> None:
        """Make the data's state the present one."""
        mujoco.mj_getState(self.model, self.data, self._snapshot, _STATE)
        self._loaded = False

    def _load(self) -> None:
        if not self._loaded:
            mujoco.mj_setState(self.model, self.data, self._snapshot, _STATE)
            self._loaded, self._forwarded = True, False

    def _load_to_step(self) -> None:
        """The data at the present state; the caller may change it."""
        self._load()
        self._loaded = False

    @property
    def time(self) -> float:
        """Time of the present state, s; under a delay the predicted one."""
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

    def forward(self) -> mujoco.MjData:
        """The plant's data with every derived quantity up to date at the present state.

        The env's own lag one substep behind `qpos` after a step.
        """
        self._load()
        if not self._forwarded:
            self._linearise()
            self._forwarded = True
        return self.data

    def _linearise(self) -> None:
        """`forward` at the control nearest to zero, about which contact forces are linearised."""
        self.data.ctrl[:] = self._idle
        mujoco.mj_forward(self.model, self.data)

    @property
    def f(self) -> Array:
        """Drift of (qpos, qvel), shape (nq + nv,): at zero control, with bias forces and active constraints."""
        return np.concatenate(
            [of_model.position_rate(self.model, self.qpos, self.qvel), self.acceleration[0]]
        )

    @property
    def g(self) -> Array:
        """Control matrix, shape (nq + nv, nu); positions do not respond at once."""
        return np.vstack([np.zeros((self.model.nq, self.model.nu)), self.acceleration[1]])

    @property
    def acceleration(self) -> tuple[Array, Array]:
        """`qacc = drift + effect @ u`: shapes (nv,) and (nv, nu)."""
        if self._affine is None:
            self.forward()
            self._affine = self._response.drift_and_effect()
        return self._affine

    @property
    def acting_range(self) -> tuple[Array, Array]:
        """The controls between which the force still changes at some time of the control interval, shapes (nu,).

        Narrower than the bounds where a forcerange clamps; f + g u is not valid beyond it.
        """
        if not self._clamped:
            return self.lower, self.upper
        motion = self.actuators.motion_without_kinematics(self.qpos, self.qvel)
        if motion is None:
            data = self.forward()
            motion = data.actuator_length, data.actuator_velocity
        return self.actuators.acting_range(*motion, self.control_dt)

    def inertia_diagonal(self) -> Array:
        """Diagonal of the joint-space inertia, shape (nv,), kg or kg m^2."""
        return np.diag(of_model.inertia(self.model, self.forward()))

    def forecast(self, control: Array, horizon: int = 1, euler: bool = False) -> Forecast:
        """A control, shape (nu,), held for one control interval, then every actuator brakes its own motion.

        `horizon` >= 1 counts all control intervals. Braking, with `euler` by Euler steps, is one way to continue, not
        the best one. A forecast is kept until the next observation, so that constraints share it.
        """
        key = control.tobytes()
        known = self._forecasts.get((key, euler))
        if known is None or len(known.published) < horizon:
            known = known or self._forecasts.get((key, not euler))
            self._load_to_step()
            known = self._recorder.record(control, horizon, known and known.first(1), euler)
            self._forecasts[key, euler] = known
        return known.first(horizon)

    def sketch(self, control: Array, horizon: int) -> Forecast:
        """A forecast by Euler steps alone, of little price where the model's are Runge-Kutta's; not kept."""
        known = self._forecasts.get((control.tobytes(), False))
        if known is not None and len(known.published) >= horizon and not self._recorder.is_runge_kutta:
            return known.first(horizon)
        self._load_to_step()
        return self._recorder.sketch(control, horizon)

    def contact_forecast(self, control: Array) -> ContactForecast:
        """Contacts with the fixed world while a control, shape (nu,), is held for one interval; kept as forecasts."""
        key = control.tobytes()
        if key not in self._contact_forecasts:
            self._load_to_step()
            self._recorder.act(self.data, control)
            self._contact_forecasts[key] = self._contact_reader.follow(self.data, self.substeps)
        return self._contact_forecasts[key]

    def under(self, control: Array) -> mujoco.MjData:
        """The plant's data with every derived quantity at the present state under a control, shape (nu,)."""
        self._load_to_step()
        self._recorder.act(self.data, control)
        mujoco.mj_forward(self.model, self.data)
        return self.data

    @property
    def weight_n(self) -> float:
        """Weight of everything that moves, N; without gravity its mass in kg."""
        return of_model.weight_n(self.model)

    def braking(self) -> Array:
        """The control by which a forecast brakes, at the present state, shape (nu,)."""
        return self._recorder.braking(self.forward())

    def pose(self) -> mujoco.MjData:
        """The plant's data with positions of bodies up to date at the present state; cheaper than `forward`."""
        self._load()
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
        """The env's own data, whose derived quantities lag; None under a delay, when the state is predicted."""
        return None if self._delay_steps else self._raw.data

    def path(self, control: Array) -> list[Array]:
        """The states (qpos, qvel) after each physics substep of a held control."""
        return list(self.forecast(control).path)

    def motion(self, kind: str, name: str) -> tuple[Array, Array]:
        """Position (3,), m, and velocity (3,), m/s, of a named frame's origin; much cheaper than `point`."""
        data = self.pose()
        if not self._forwarded:
            mujoco.mj_comPos(self.model, data)  # for the Jacobian
        p, jacobian = self.frames.jacobian(kind, name)
        return p.copy(), jacobian @ self.qvel

    def point(self, kind: str, name: str) -> tuple[Array, Array, Array, Array]:
        """Position p, m, and velocity v, m/s, of a named "body", "site" or "geom", and its acceleration, m/s^2.

        The last is `a0 + A @ u`: p, v and a0 of shape (3,), A of shape (3, nu).
        """
        response = self.acceleration
        p, jacobian = self.frames.jacobian(kind, name)
        return p.copy(), *point_motion(jacobian, self.frames.jacobian_rate(kind, name), self.qvel, *response)

    def named(self, kind: str, name: str) -> int:
        """The id of a body, site, geom, joint or actuator; for an unknown name an error that lists all."""
        return of_model.named(self.model, kind, name)

    def names(self, kind: str, pattern: str = "*") -> list[str]:
        """All names of a kind that match a shell pattern."""
        return of_model.names(self.model, kind, pattern)

    def attribute(self, name: str) -> Any:
        """Read a published fact of the env."""
        found = getattr(self._raw, name, None)
        return found if found is not None else env_checks.read_attribute(self._env, name)


def require_mujoco(plant: Plant, message: str) -> MujocoPlant:
    """The plant, if it is a MujocoPlant; else an UnsupportedEnvError with the message."""
    if not isinstance(plant, MujocoPlant):
        raise UnsupportedEnvError(message)
    return plant
