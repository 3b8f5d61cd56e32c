"""MujocoPlant: f and g of any env with a MuJoCo model and data, and where a control leads."""

import copy
from collections import deque
from typing import Any, ClassVar, Final

import gymnasium as gym
import mujoco
import numpy as np

from safe_wrappers.control.bandwidth import ControlLoop
from safe_wrappers.errors import Array, ConfigurationError, UnsupportedEnvError, non_negative
from safe_wrappers.plants import env_checks
from safe_wrappers.plants.mujoco import binding
from safe_wrappers.plants.mujoco import model as of_model
from safe_wrappers.plants.mujoco.actuators import AffineActuators
from safe_wrappers.plants.mujoco.contacts import ContactReader, Contacts, on_the_world
from safe_wrappers.plants.mujoco.forecast import MujocoTrajectory, Poses, Recorder
from safe_wrappers.plants.mujoco.model import (
    DYNAMICS,
    PLACES,
    Constants,
    different_fields,
    every_constant,
)
from safe_wrappers.plants.plant import Plant

STATE: Final = int(mujoco.mjtState.mjSTATE_INTEGRATION)


_ROUNDING = 1e-6, 1e-6
"""Of controls and states, relative and absolute: envs may compute in single precision."""


class MujocoPlant(Plant):
    """`x = (qpos, qvel)`, `x' = f + g u`, through the actuators and the active constraints.

    u is the env's action. f and g hold for the present set of active contacts and limits, and are exact for pyramidal
    friction cones. It simulates the env's own model on data of its own; the env's data are only read. So a model
    that is changed, at a reset or in mid-episode (domain randomisation), is the one that is simulated; constants that
    are read once are read again.

    Args:
        model: None takes the env's `.model`; a function of the unwrapped env returns it where it is elsewhere. A
            model (other masses) is the filter's in place of the env's, to test mismatch, and does not follow it.
        delay_s: Evidence age plus detection plus actuation delay in s, over which this plant's model predicts.
        data: A function of the unwrapped env that returns its data; None: they are its `.data`.
        control_dt: How long the env holds an action, s; needed where it has no `dt` or `frame_skip`.
        loop: The `plants.ControlLoop` that your controller closes; a warning says where too little of its margin is
            left.

    Attributes:
        action_map: By which the env makes controls of actions, where the action space is not the control range; found
            by stepping a copy of the env at binding. None where an action is a control.

    Raises:
        UnsupportedEnvError: No MuJoCo model, a disabled actuator, one not affine, or actions that no map fits.
    """

    can_brake: ClassVar[bool] = True
    _sends_controls: ClassVar[bool] = True  # an action says what the env's controls are
    model: mujoco.MjModel  #: the plant's own
    data: mujoco.MjData  #: likewise; at the present state only after `forward` or `pose`
    _loaded = _forwarded = False
    _range: tuple[Array, Array]  # of the controls, as `lower` and `upper` are of the actions
    action_map: binding.ActionMap | None = None

    def __init__(
        self,
        model: mujoco.MjModel | binding.ModelOf | None = None,
        delay_s: float = 0.0,
        *,
        data: binding.DataOf | None = None,
        control_dt: float | None = None,
        loop: ControlLoop | None = None,
    ) -> None:
        self._given = model if isinstance(model, mujoco.MjModel) else None
        self._functions: tuple[Any, Any] = (None if self._given is not None else model, data)
        if not isinstance(loop, ControlLoop | None):
            example = "sw.plants.ControlLoop(crossover=4.0, phase_margin_deg=60.0)"
            raise ConfigurationError(f"loop is a ControlLoop, such as {example}, or None; got {loop!r}")
        self._given_dt = control_dt
        self.delay_s = non_negative("delay_s", delay_s, "s")
        self._pending: deque[Array] = deque()
        self._factors, self._loop = (1.0, 1.0), loop
        self._raw: Any = None
        self._sent: Array | None = None
        self._outdated = False

    def bind(self, env: gym.Env[Any, Any]) -> None:
        raw: Any = env.unwrapped
        env_checks.refuse_second_env(self._raw, env)
        env_checks.refuse_changed_actions(env)
        found_elsewhere = any(function is not None for function in self._functions)
        self._source: Any = binding.Accessed(raw, *self._functions) if found_elsewhere else raw
        bound_before, self._raw, self._env = self._raw is not None, raw, env
        self._env_model = self.model = None
        self._take_model()
        if self._loop is not None and not bound_before:
            self._loop.warn_if_short(self.control_dt, self.delay_s)

    def _take_model(self) -> None:
        """Read the model anew: at binding, and when the env's has changed."""
        source = self._source
        model = binding.checked_model(source, self._given)
        if self._factors != (1.0, 1.0):
            model = copy.copy(model)
            _scale(model, *self._factors)
        moved = source.model is not self._env_model
        if moved and self._env_model is not None:
            expected, found = ((m.nq, m.nv, m.nu) for m in (self._env_model, source.model))
            if found != expected:
                raise UnsupportedEnvError(
                    f"the env has made itself another machine: expected (nq, nv, nu) = {expected} as when the filter "
                    f"was built, got {found}; build the filter anew"
                )
        self.model = model
        self._constants = Constants(source.model, (*DYNAMICS, *PLACES))
        self._dynamics = Constants(source.model, DYNAMICS)
        self._every_constant = every_constant(source.model)
        self._mismatch = (
            ", ".join(different_fields(model, source.model)[:8]) if model is not source.model else ""
        )
        self.substeps = binding.physics_steps(self._raw, source, self._given_dt)
        if moved or model is not source.model:
            self.data = mujoco.MjData(model)
        self.actuators = AffineActuators(model)
        lower, upper = of_model.control_range(model)
        if moved or not (np.array_equal(lower, self._range[0]) and np.array_equal(upper, self._range[1])):
            self._range = self.lower, self.upper = lower, upper
            self._bind_actions(self._env)
        self._clamped = bool(model.actuator_forcelimited.any()) or (
            self.action_map is not None and self.action_map.exceeds(lower, upper)
        )
        self._idle = self.controls(np.clip(0.0, self.lower, self.upper))
        self.control_dt = env_checks.check_timing(self._env, self.substeps * float(model.opt.timestep))
        if moved:
            self._nq, self._nv = int(model.nq), int(model.nv)
            self._snapshot: Array = np.zeros(mujoco.mj_stateSize(model, STATE))
        self._delay_steps = int(np.ceil(self.delay_s / model.opt.timestep - 1e-9))
        self._pending = deque(self._pending, maxlen=max(1, -(-self._delay_steps // self.substeps)))
        self._recorder = self._new_recorder()
        self._contact_reader = ContactReader(model, on_the_world(model))
        # Last: a model that was refused is refused again at the next observation.
        self._env_model, self._outdated = source.model, False
        self.model_version += 1
        self._forget()

    def _new_recorder(self) -> Recorder:
        return Recorder(self.model, self.data, self.substeps, self.action_map)

    def _bind_actions(self, env: gym.Env[Any, Any]) -> None:
        """Find the bounds of the action, and the map from it to the control."""
        self.action_map = binding.action_map_of(env, self._source, self.lower, self.upper)
        if self.action_map is not None:
            self.lower, self.upper = self.action_map.low, self.action_map.high

    def controls(self, action: Array) -> Array:
        """The model's control that the env makes of an action, shapes (nu,)."""
        return action if self.action_map is None else self.action_map.control(action)

    def perturb(self, mass: float = 1.0, damping: float = 1.0) -> None:
        """Scale the masses (and inertias) and joint damping of the plant's own model, now or once it has one."""
        if not (mass > 0.0 and damping >= 0.0):
            raise ConfigurationError(f"factors must be positive, got mass={mass}, damping={damping}")
        self._factors = (self._factors[0] * mass, self._factors[1] * damping)
        if self._raw is not None:
            self._take_model()

    def _forget(self) -> None:
        """Called when the state or the model has changed."""
        self._loaded = self._forwarded = False
        self._affine: tuple[Array, Array] | None = None
        self._forecasts: dict[tuple[bytes, bool], MujocoTrajectory] = {}
        self._contact_forecasts: dict[bytes, Contacts] = {}

    def observe(self) -> None:
        """Take the env's present state; everything else is computed on demand."""
        self.follow()
        mujoco.mj_getState(self._source.model, self._source.data, self._snapshot, STATE)
        self._forget()
        self.observation_id += 1
        # MuJoCo resets a state with a NaN: a prediction would hide it.
        if self._delay_steps and bool(np.isfinite(self._snapshot).all()):
            self._predict_over_delay()

    def executed(self, control: Array | None) -> None:
        self._sent, self._sent_at = control, float(self._source.data.time)
        if control is None:
            self._pending.clear()
            self._outdated |= self._every_constant.changed()
            self.follow()
        elif self._delay_steps:
            self._pending.append(np.array(control))

    def deviation(self) -> str:
        """How the env's last step was not what was decided; "" if it was, as far as can be seen.

        Compared are the models, the time that has passed, the controls and, where the step was forecast, the state.
        """
        if self._mismatch:
            return f"the plant's model is not the env's: they differ in {self._mismatch}"
        data, sent = self._source.data, self._sent
        if sent is None:
            return ""
        passed = float(data.time) - self._sent_at
        if abs(passed - self.control_dt) > 1e-6 * self.control_dt + 1e-12 * abs(self._sent_at):
            return f"a step took {passed:g} s of simulation instead of {self.control_dt:g} s"
        if self._dynamics.changed():
            return "the env's model changed during the step"
        control = self.controls(sent)
        if self._sends_controls and not _same(data.ctrl, control):
            return f"the env was sent {control} and applied {data.ctrl}"
        key = sent.tobytes()
        known = self._forecasts.get((key, False)) or self._forecasts.get((key, True))
        if known is None or self._delay_steps:
            return ""
        state, end = np.concatenate([data.qpos, data.qvel]), known.states[self.substeps - 1]
        same = _same(state, end)
        return "" if same else f"the step ended {np.abs(state - end).max():.3g} from its forecast"

    def follow(self) -> None:
        self._outdated |= self._source.model is not self._env_model or self._constants.changed()
        if self._outdated:
            self._take_model()

    def _predict_over_delay(self) -> None:
        self._load()
        # The oldest command has already acted in part; before the first one the env's own control acts.
        early = self._delay_steps - self.substeps * len(self._pending)
        if early > 0:
            mujoco.mj_step(self.model, self.data, early)
        for i, control in enumerate(self._pending):
            self._recorder.act(self.data, control)
            mujoco.mj_step(self.model, self.data, self.substeps + (min(early, 0) if i == 0 else 0))
        mujoco.mj_getState(self.model, self.data, self._snapshot, STATE)
        self._loaded = False

    def _load(self) -> None:
        if not self._loaded:
            self._recorder.forget()
            mujoco.mj_setState(self.model, self.data, self._snapshot, STATE)
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
        return self._snapshot[1 : 1 + self._nq + self._nv]

    def named(self, kind: str, name: str, argument: str = "") -> int:
        """The id of a body, site, geom, joint or actuator; for an unknown name an error that lists all.

        The error also says which `argument` has the name, where the caller may have left that at its default.
        """
        return of_model.named(self.model, kind, name, argument)

    def names(self, kind: str) -> list[str]:
        """All names of a kind."""
        return of_model.names(self.model, kind)

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
            self._affine = self.actuators.drift_and_effect(self.forward())
            if self.action_map is not None:
                self._affine = self.action_map.per_action(*self._affine)
        return self._affine

    @property
    def acting_range(self) -> tuple[Array, Array]:
        """The controls between which the force still changes at some time of the control interval, shapes (nu,).

        Narrower than the bounds where a forcerange clamps; f + g u is not valid beyond it.
        """
        if not self._clamped:
            return self.lower, self.upper
        motion = self.actuators.motion(self.pose())
        ends = self.actuators.acting_range(*motion, self.control_dt)
        return ends if self.action_map is None else self.action_map.actions_between(*ends)

    def rollout(self, control: Array | None, horizon: int = 1, euler: bool = False) -> MujocoTrajectory:
        """A control, shape (nu,), held for one control interval, then every actuator brakes its own motion.

        `horizon` >= 1 counts all control intervals. Braking, with `euler` by Euler steps, is one way to continue, not
        the best one. A trajectory is kept until the next observation, so that constraints share it.
        """
        if control is None:
            return _Present(self)  # not kept: it refers to the plant
        key = control.tobytes()
        known = self._forecasts.get((key, euler))
        if known is None or known.holds < horizon:
            first = known or self._forecasts.get((key, not euler))
            if first is not None and self._recorder.goes_on(control):
                first = first.first(1)
            else:
                first = None
                self._load_to_step()
            known = self._recorder.record(control, horizon, first, euler)
            self._forecasts[key, euler] = known
        return known.first(horizon)

    def sketch(self, control: Array, horizon: int = 1) -> MujocoTrajectory:
        """A trajectory by Euler steps alone, of little price where the model's are Runge-Kutta's; not kept."""
        known = self._forecasts.get((control.tobytes(), False))
        if known is not None and known.holds >= horizon and not self._recorder.is_runge_kutta:
            return known.first(horizon)
        self._load_to_step()
        return self._recorder.sketch(control, horizon)

    def contact_forecast(self, control: Array) -> Contacts:
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
        return None if self._delay_steps else self._source.data

    def motion(self, kind: str, name: str) -> tuple[Array, Array]:
        """Position (3,), m, and velocity (3,), m/s, of a named frame's origin; much cheaper than `point`."""
        data = self.pose()
        if not self._forwarded:
            mujoco.mj_comPos(self.model, data)  # for the Jacobian
        p, jacobian = of_model.frame(self.model, self.data, kind, name)
        return p, jacobian @ self.qvel

    def point(self, kind: str, name: str) -> tuple[Array, Array, Array, Array]:
        """Position p, m, and velocity v, m/s, of a named "body", "site" or "geom", and its acceleration, m/s^2.

        The last is `a0 + A @ u`: p, v and a0 of shape (3,), A of shape (3, nu).
        """
        drift, effect = self.acceleration
        p, jacobian = of_model.frame(self.model, self.data, kind, name)
        _, rate = of_model.frame(self.model, self.data, kind, name, mujoco.mj_jacDot)
        return p, jacobian @ self.qvel, jacobian @ drift + rate @ self.qvel, jacobian @ effect

    def attribute(self, name: str) -> Any:
        found = getattr(self._raw, name, None)
        return found if found is not None else super().attribute(name)


def _same(one: Array, other: Array) -> bool:
    """Whether they are equal up to rounding, NaN included."""
    return one.tobytes() == other.tobytes() or np.allclose(one, other, *_ROUNDING, equal_nan=True)


class _Present(MujocoTrajectory):
    """The present state alone, valid until the next observation."""

    def __init__(self, plant: MujocoPlant) -> None:
        super().__init__(plant._recorder, None, plant.state[None], np.empty((0, 2, 0, 3)))
        self._plant = plant

    def poses(self, every: int = 1) -> Poses:
        pose = self._plant.pose()
        return Poses(pose.xpos[None], pose.xmat.reshape(1, -1, 3, 3), pose.xipos[None])


def _scale(model: mujoco.MjModel, mass: float, damping: float) -> None:
    model.body_mass *= mass
    model.body_inertia *= mass
    model.dof_damping *= damping
    mujoco.mj_setConst(model, mujoco.MjData(model))


def require_mujoco(plant: Plant, message: str) -> MujocoPlant:
    """The plant, if it is a MujocoPlant; else an UnsupportedEnvError with the message."""
    if not isinstance(plant, MujocoPlant):
        raise UnsupportedEnvError(message)
    return plant
