"""ChunkHandover: from the chunks of a policy to one stream of commands with a bounded rate."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers import info as keys
from safe_wrappers.control.handover import (
    LOOK_BACK,
    Fade,
    SeamCheck,
    SeamLimits,
    hermite_spline,
    join,
    limit_of_each,
    shortest_blend,
)
from safe_wrappers.control.watchdog import admits, transit_time
from safe_wrappers.errors import (
    Array,
    ConfigurationError,
    UnsupportedEnvError,
    numbers_of,
    positive,
    settings_from,
    whole_number,
)
from safe_wrappers.filter.fallback import FallbackFunction
from safe_wrappers.plants import own_plant
from safe_wrappers.plants.env_checks import check_actions, check_timing, refuse_changed_actions
from safe_wrappers.plants.mujoco.binding import actions_are_controls
from safe_wrappers.plants.mujoco.dynamics import InverseDynamics
from safe_wrappers.plants.mujoco.model import control_range
from safe_wrappers.plants.mujoco.plant import MujocoPlant
from safe_wrappers.plants.plant import Plant
from safe_wrappers.wrappers.layer import (
    SAME_STEP,
    CommandReceiver,
    Env,
    LayerWrapper,
    Step,
    WrapperRng,
    action_array,
    receiver_inside,
    whole_steps,
)
from safe_wrappers.wrappers.stack import Layer
from safe_wrappers.wrappers.stopping import FallbackController, bound_plant


class Chunk(NamedTuple):
    """A chunk on its way, or there."""

    commands: Array  # shape (h, m), the first one for the control step of the observation
    observed: int  # control step of the observation
    due: int  # control step at which it is there


class ChunkHandover(LayerWrapper, CommandReceiver):
    """Executes action chunks that come late, over seams that keep a rate limit.

    The action space becomes the chunk, shape (H, m). One `step(chunk)` is `execution_horizon` control steps, whose
    rewards are summed up. A chunk's entry j is meant for the j-th control step after its observation; with an
    `inference_delay` of d it takes over at its entry d, over a blend. Without a left-over the fallback acts. With
    `chunk_size=1, execution_horizon=1` it takes actions (m,), too.

    **What it guarantees.** With `rate_limit`, neighbouring commands of an episode differ by at most `rate_limit`
    times the control interval in every component, whatever the chunks (`handover/limited` counts those held back). A
    chunk with an entry that is not finite is refused as a whole; entries outside the action box are clipped. **What
    it does not.** A filter inside may have to break the limit. It does not check that a chunk is safe: `LeaseExpiry`
    and `CBFActionFilter` belong inside.

    Args:
        env: With a one-dimensional Box action space.
        chunk_size: H, entries of a chunk.
        execution_horizon: s, control steps from one chunk's observation to the next; `d <= s <= n - d`, where n are
            the control steps of a chunk (H if an entry is for one).
        inference_delay: d, control steps; or [least, most], drawn anew for every chunk.
        blend_time: s, the least duration of a blend.
        rate_limit: Bound on |u[k+1] - u[k]| / control interval, for all components or one each, action units per s.
        fallback: "brake", "hold", "zero", or a function of the plant; "brake" needs MuJoCo or a plant.
        plant: For the fallback; None reads the env's MuJoCo model.
        steps_per_entry: Control steps from one entry of a chunk to the next, with a cubic Hermite spline between.
        limits: Of the machine, a `SeamLimits` or the dict of one. With it blends are quintics with second derivatives
            matched at both ends, which are stretched until they keep the limits in between, too; without one that
            does, or with an end out of reach, the chunk is refused. Between chunks of one `rate_limit` alone counts.

    Info, at every step: ``handover/peak_jerk``, ``handover/starved``, ``handover/limited``, ``handover/refused``,
    ``action/clipped``; that of the layers inside is merged over the control steps (`safe_wrappers.info`).

    Raises:
        ConfigurationError: Sizes that do not fit together, a time or limit that is not positive, nothing to blend.
        ActionError: A chunk of the wrong shape; the env was not stepped.

    Example:
        >>> import gymnasium as gym, safe_wrappers as sw
        >>> env = sw.ChunkHandover(gym.make("Reacher-v5"), chunk_size=16, execution_horizon=8, rate_limit=20.0)
        >>> _ = env.reset(seed=0)
        >>> info = env.step(env.action_space.sample())[4]
        >>> info["handover/peak_jerk"] <= 20.0
        True
    """

    layer: ClassVar = Layer.HANDOVER

    def __init__(
        self,
        env: Env,
        chunk_size: int,
        execution_horizon: int,
        inference_delay: int | Sequence[int] = 0,
        blend_time: float | None = None,
        rate_limit: float | Sequence[float] | None = None,
        fallback: str | FallbackFunction = "brake",
        plant: Plant | None = None,
        steps_per_entry: int = 1,
        limits: SeamLimits | Mapping[str, Any] | None = None,
    ) -> None:
        LayerWrapper.__init__(self, env)  # first: with a handover inside the actions are no vector either
        space = check_actions(env)
        plant = own_plant(plant)
        self._set_sizes(chunk_size, execution_horizon, inference_delay, steps_per_entry)
        self.control_dt = check_timing(env)
        self._controls = space.shape[0]
        low, high = (np.repeat(end[None], chunk_size, axis=0) for end in (space.low, space.high))
        self.action_space = gym.spaces.Box(low, high, dtype=space.dtype)
        self._dtype: Any = np.dtype(space.dtype)
        largest = min(float(np.finfo(self._dtype).max), float(np.finfo(np.float32).max))
        self._low = np.maximum(np.asarray(space.low, np.float64), -largest)
        self._high = np.minimum(np.asarray(space.high, np.float64), largest)
        if limits is not None:
            limits = settings_from(SeamLimits, limits, "limits")
        given = [] if limits is None else vars(limits).values()
        if all(one is None for one in (blend_time, rate_limit, *given)):
            raise ConfigurationError("how long are blends? Give rate_limit, blend_time or limits")
        self._fewest = 0 if blend_time is None else self._fewest_steps(blend_time)
        self._rate_limit = limit_of_each("rate_limit", rate_limit, self._controls, "action units per second")
        step = self._rate_limit * self.control_dt
        # The difference of two commands, divided by the interval again, must not come out above the limit.
        self._step = np.where(step / self.control_dt > self._rate_limit, np.nextafter(step, 0.0), step)
        self._fallback = FallbackController(env, fallback, bound_plant(env, plant, fallback))
        self._check: SeamCheck | None = None
        self._admission: Admission | None = None
        if limits is not None:
            self._check = self._bound_check(limits)
            if limits.arrival is not None:
                self._admission = Admission(env, limits, self._check)
        self._inside = receiver_inside(env)
        self._random = WrapperRng(type(self).__name__)

    def _begin(self, observation: Any, info: dict[str, Any], seed: int | None) -> Any:
        self._random.reset(self.env, seed)
        self._fallback.reset()
        self._steps_done, self._observed_s = 0, 0.0
        self._observed = -1  # control step that the commands' observation is from; -1 before there was any
        self._coming: list[Chunk] = []
        self._sent = self._plan = np.zeros((0, self._controls))
        self._starving: bool | None = None
        self._fade = Fade()
        self._executed: list[Array] = []
        self._starved = self._limited = 0
        self._refused, self._clipped = False, 0.0
        info.update(self._measured())
        return observation

    def step(self, action: Any) -> Step:
        """Execute the next `execution_horizon` control steps, with this chunk from when it is there."""
        self._refuse_without_reset()
        chunk = self._checked(action)
        self._clipped = self._beyond(chunk)
        self._starved = self._limited = 0
        self._refused = not self._submit(chunk)
        answer = self._make_steps(self.execution_horizon, self._control_step)
        self._observed_s = self.now_s
        answer[4].update(self._measured())
        return answer

    def _control_step(self) -> Step:
        command = self._next()
        if self._inside is not None:
            observed_s = None if self._observed < 0 else self._observed * self.control_dt
            self._inside.set_observation_time(observed_s)
        answer = self.env.step(command)
        self._steps_done += 1
        executed = np.array(answer[4].get(keys.EXECUTED_ACTION, command), dtype=np.float64)
        self._fallback.executed(executed)
        self._executed.append(executed)
        return answer

    def _set_sizes(
        self, chunk_size: Any, execution_horizon: Any, inference_delay: Any, steps_per_entry: Any
    ) -> None:
        """Keep the counts, the delay as least and most; or an error where they do not fit together."""
        self._apart = whole_number("steps_per_entry", steps_per_entry, 1, "control steps")
        # One entry leads to no other.
        self.chunk_size = whole_number("chunk_size", chunk_size, 1 if self._apart == 1 else 2, "entries")
        self.execution_horizon = whole_number("execution_horizon", execution_horizon, 1, "control steps")
        both = inference_delay if isinstance(inference_delay, list | tuple) else [inference_delay] * 2
        delay = tuple(whole_number("inference_delay", one, 0, "control steps") for one in both)
        if len(delay) != 2 or delay[0] > delay[1]:
            raise ConfigurationError(
                f"inference_delay is d control steps or [least, most], got {inference_delay!r}"
            )
        self._delay, self._size = delay, (self.chunk_size - 1) * self._apart + 1
        if not delay[1] <= self.execution_horizon <= self._size - delay[1]:
            raise ConfigurationError(
                f"d <= s <= H - d must hold; got inference_delay d = {delay[1]}, execution_horizon s = "
                f"{self.execution_horizon}, and a chunk of H = {self._size} control steps"
            )

    def _fewest_steps(self, blend_time: float) -> int:
        """The fewest control steps of a blend."""
        fewest = max(whole_steps(positive("blend_time", blend_time, "s"), self.control_dt) - 1, 1)
        rest = self._size - self._delay[1]
        if fewest >= rest and self.chunk_size > 1:
            raise ConfigurationError(
                f"a blend of {fewest} control steps does not fit into what is left of a chunk when it takes over, "
                f"{rest} control steps: choose a longer chunk_size or a shorter blend_time"
            )
        return fewest

    def _bound_check(self, limits: SeamLimits) -> SeamCheck:
        dynamics = None
        if limits.torque is not None or limits.torque_slew is not None:
            plant = self._fallback.plant
            if not isinstance(plant, MujocoPlant):
                plant = MujocoPlant()
                plant.bind(self.env)
            dynamics = InverseDynamics(plant)
        return SeamCheck(limits, self._controls, self.control_dt, dynamics)

    def _checked(self, action: Any) -> Array:
        given, shape = numbers_of(action), (self.chunk_size, self._controls)
        one = given is not None and self.chunk_size == 1 and given.ndim == 1  # an ordinary policy's action
        return action_array(action, shape[1:] if one else shape, np.float64).reshape(shape)

    def _submit(self, chunk: Array) -> bool:
        """Send the chunk on its way; False if one came and was refused.

        Refused are a chunk with an entry that is not finite, with knots that the machine does not bear, and one whose
        observation is in the future or not newer than all before it.
        """
        delay = int(self._random.draw.integers(self._delay[0], self._delay[1] + 1))
        if self._observed_s is None:
            return True
        observed = math.floor(self._observed_s / self.control_dt + SAME_STEP)
        newest = max([self._observed, *(one.observed for one in self._coming)])
        if not newest < observed <= self._steps_done or not np.isfinite(chunk).all():
            return False
        chunk = np.clip(chunk, self._low, self._high)
        if self._apart > 1:
            if self._check is not None and not self._check.bears_knots(chunk, self._apart * self.control_dt):
                return False
            spline = hermite_spline(chunk, float(self._apart))(np.arange(float(self._size)))
            spline[:: self._apart] = chunk  # bit for bit; between its entries it may overshoot their range
            chunk = np.clip(spline, self._low, self._high)
        self._coming.append(Chunk(chunk, observed, self._steps_done + delay))
        return True

    def _next(self) -> NDArray[Any]:
        """The command of this control step, in the env's dtype, inside its box and the rate limit."""
        seam = self._take_over()
        starving = not len(self._plan)
        self._starved += starving
        if starving:
            control = np.clip(self._fallback.command(), self._low, self._high)
        else:
            control, self._plan = self._plan[0], self._plan[1:]
        if starving != self._starving and len(self._sent) and not seam:
            # A longer chunk that takes over blends by itself; everything else starts from the last command.
            self._fade = Fade(self._sent[-1], self._fade_steps(control))
        self._starving = starving
        sent = self._sendable(self._fade(control))
        self._sent = np.concatenate([self._sent[-LOOK_BACK + 1 :], sent[None].astype(np.float64)])
        return sent

    def _take_over(self) -> bool:
        """Let the newest chunk that is there and may take over; whether over a seam.

        A chunk of one has no left-over to blend with: only a change to and from the fallback is faded over.
        """
        now, seam = self._steps_done, False
        for chunk in reversed([one for one in self._coming if one.due <= now]):
            fresh = chunk.commands[now - chunk.observed :]
            end_s, admission = len(fresh) * self.control_dt, self._admission
            if not len(fresh) or (admission is not None and not admission.admits(fresh[-1], end_s)):
                self._refused = True
                continue
            joined = (fresh, 0) if self.chunk_size == 1 else self._joined(fresh)
            if joined is None:
                self._refused = True
                break
            self._coming = [one for one in self._coming if one.observed > chunk.observed]
            self._observed, self._plan = chunk.observed, joined[0]
            if self.chunk_size > 1:
                self._fade, seam = Fade(), len(self._sent) > 0
            break
        self._coming = [one for one in self._coming if one.due > now]
        return seam

    def _joined(self, fresh: Array) -> tuple[Array, int] | None:
        """The blend into a chunk's rest, shape (n, m), and its steps; None if none keeps the machine's limits."""
        if self._check is None:
            return join(self._sent, self._plan, fresh, self._step, self._fewest)
        return self._check.join(self._sent, fresh, self._step, self._fewest, self._low, self._high)

    def _fade_steps(self, target: Array) -> int:
        """Control steps between the latched command and the new one that keep the limits, were both at rest."""
        limits = [(1, self._rate_limit), *enumerate([] if self._check is None else self._check.bounds, 1)]
        change = np.abs(target - self._sent[-1])
        shortest = max(float(shortest_blend(change, limit, order).max()) for order, limit in limits)
        return max(self._fewest, whole_steps(shortest, self.control_dt) - 1)

    def _sendable(self, control: Array) -> NDArray[Any]:
        """The command in the env's dtype, within the box and the limit; one that has to be held back is counted."""
        control = np.clip(control, self._low, self._high)
        if not len(self._sent):
            return control.astype(self._dtype)
        last = self._sent[-1]
        kept = np.clip(control, last - self._step, last + self._step)
        sent = kept.astype(self._dtype)
        # Rounding alone may break the limit by a hair: one number back, which is not called holding back.
        too_far = np.abs(sent - last) > self._step
        sent = np.where(too_far, np.nextafter(sent, last.astype(self._dtype)), sent)
        hair = 2.0 * float(np.finfo(self._dtype).eps) * np.maximum(np.abs(control), np.abs(last))
        self._limited += bool((np.abs(control - kept) > np.minimum(hair, 0.5 * self._step)).any())
        return sent

    def _beyond(self, chunk: Array) -> float:
        """By how much the entry left the action space that left it farthest; the first chunk is warned of."""
        space: Any = self.action_space
        finite = np.where(np.isfinite(chunk), chunk, 0.0)
        beyond = np.clip(finite, space.low, space.high) - finite
        clipped = max(math.hypot(*entry) for entry in beyond)
        if clipped > 0.0:
            message = f"the policy's action left the action space by {clipped:.3g}; it is clipped"
            self._warn_once("clipped", f"{message} (action/clipped)")
        return clipped

    def _measured(self) -> dict[str, Any]:
        """The info of the control steps since the last call."""
        executed = np.array(self._executed).reshape(-1, self._controls)
        peak = float(np.abs(np.diff(executed, axis=0)).max(initial=0.0)) / self.control_dt
        if self._limited:
            message = "a command was held back to keep rate_limit: the chunk is too short or fast (handover/limited)"
            self._warn_once("limited", message)
        self._executed = self._executed[-1:]
        return {
            keys.HANDOVER_PEAK_JERK: peak,
            keys.HANDOVER_STARVED: self._starved,
            keys.HANDOVER_LIMITED: self._limited,
            keys.HANDOVER_REFUSED: self._refused,
            keys.ACTION_CLIPPED: self._clipped,
        }


class Admission:
    """Refuses chunks that no motion within the limits could follow to their end; a necessary condition only.

    With arrival "moving" the end may be passed at any speed; with "rest" the machine must be able to stand there in
    time. Where it is, the lengths and velocities of the MuJoCo actuators say.
    """

    def __init__(self, env: Env, limits: SeamLimits, check: SeamCheck) -> None:
        self._raw: Any = env.unwrapped
        model: Any = getattr(self._raw, "model", None)
        if not isinstance(model, mujoco.MjModel):
            raise UnsupportedEnvError("limits.arrival is for MuJoCo's actuators, whose lengths are read")
        if not actions_are_controls(env.action_space, *control_range(model)):
            raise ConfigurationError(
                "limits.arrival is for setpoints: actions in units of the actuators' lengths"
            )
        refuse_changed_actions(env)
        if limits.arrival not in ("moving", "rest") or limits.acceleration is None:
            raise ConfigurationError(
                f'limits.arrival is "moving" or "rest", beside an acceleration; got {limits}'
            )
        self._rest = limits.arrival == "rest"
        self._speed, self._acceleration, _ = check.bounds

    def admits(self, end: Array, duration_s: float) -> bool:
        """Whether a chunk may be executed that ends with a command (m,) after so many seconds."""
        position, velocity = self._raw.data.actuator_length, self._raw.data.actuator_velocity
        motion, limits = (end, position, velocity), (self._speed, self._acceleration)
        if self._rest:
            return transit_time(*motion, *limits) <= duration_s
        return bool(admits(*motion, duration_s, *limits).all())
