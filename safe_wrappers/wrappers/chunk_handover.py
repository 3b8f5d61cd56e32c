"""ChunkHandover: from the chunks of a policy to one stream of commands with a bounded rate."""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, ClassVar, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from safe_wrappers import info as keys
from safe_wrappers.control.handover import (
    BLENDS,
    LOOK_BACK,
    Seam,
    SeamCheck,
    SeamLimits,
    hermite_spline,
    join,
    shortest_blend,
    smoothstep,
)
from safe_wrappers.errors import (
    Array,
    ConfigurationError,
    UnknownNameError,
    numbers_of,
    positive,
    settings_from,
    whole_number,
)
from safe_wrappers.filter.fallback import FallbackFunction
from safe_wrappers.plants import own_plant
from safe_wrappers.plants.env_checks import check_actions, check_timing
from safe_wrappers.plants.mujoco.dynamics import InverseDynamics
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


class Command(NamedTuple):
    """What to send in a control step."""

    control: NDArray[Any]  # shape (m,), in the env's dtype and inside its box
    observed: int  # control step whose observation the command was made from; -1 before there was any
    starved: bool  # the queue is empty: the fallback gave it
    limited: bool  # held back beyond the blend to keep the rate limit
    refused: bool  # a chunk that has arrived was refused


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
        execution_horizon: s, control steps from one chunk's observation to the next; `d <= s <= H - d`.
        inference_delay: d, control steps; or [least, most], drawn anew for every chunk.
        blend: "smoothstep" or "quintic".
        blend_time: s, the least duration of a blend; without it and `rate_limit` blends are as long as the left-over.
        rate_limit: Bound on |u[k+1] - u[k]| / control interval, for all components or one each, action units per s.
        fallback: "brake", "hold", "zero", or a function of the plant; "brake" needs MuJoCo or a plant.
        plant: For the fallback; None reads the env's MuJoCo model.
        steps_per_entry: Control steps from one entry of a chunk to the next, with a cubic Hermite spline between.
        limits: Of the machine, which every "quintic" keeps between its ends, too: it is stretched until it does, or
            its chunk is refused.

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
        blend: str = "smoothstep",
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
        H, s, delay, apart = _sizes(chunk_size, execution_horizon, inference_delay, steps_per_entry)
        if blend not in BLENDS:
            raise UnknownNameError(f"no blend {blend!r}; choose {', '.join(BLENDS)}")
        limits = None if limits is None else settings_from(SeamLimits, limits, "limits")
        self.chunk_size, self.execution_horizon, self.blend = H, s, blend
        self.control_dt = check_timing(env)
        self._delay, self._apart, self._controls = delay, apart, space.shape[0]
        low, high = (np.repeat(end[None], H, axis=0) for end in (space.low, space.high))
        self.action_space = gym.spaces.Box(low, high, dtype=space.dtype)
        self._fallback = FallbackController(env, fallback, bound_plant(env, plant, fallback))
        if limits is not None and blend != "quintic":
            raise ConfigurationError(f'limits are kept by blend="quintic", whose ends match; got {blend!r}')
        rates = _rate_limits(rate_limit, self._controls)
        fewest = self._fewest(blend_time, rate_limit is not None or limits is not None)
        self._check = None if limits is None else self._bound_check(limits)
        self._queue = ChunkQueue(space, self.control_dt, blend, fewest, rates, self._check)
        self._inside = receiver_inside(env)
        self._random = WrapperRng(type(self).__name__)

    def _begin(self, observation: Any, info: dict[str, Any], seed: int | None) -> Any:
        self._random.reset(self.env, seed)
        self._fallback.reset()
        self._queue.reset()
        self._executed: list[Array] = []
        self._commands: list[Command] = []
        self._observed_s, self._clipped, self._refused = 0.0, 0.0, False
        info.update(self._measured())
        return observation

    def step(self, action: Any) -> Step:
        """Execute the next `execution_horizon` control steps, with this chunk from when it is there."""
        self._refuse_without_reset()
        chunk = self._checked(action)
        self._clipped = self._beyond(chunk)
        self._refused = not self._submit(chunk)
        answer = self._make_steps(self.execution_horizon, self._control_step)
        self._observed_s = self.now_s
        answer[4].update(self._measured())
        return answer

    def _control_step(self) -> Step:
        command = self._queue.next(self._admits, self._fallback.command)
        self._commands.append(command)
        if self._inside is not None:
            observed_s = None if command.observed < 0 else command.observed * self.control_dt
            self._inside.set_observation_time(observed_s)
        answer = self.env.step(command.control)
        executed = np.array(answer[4].get(keys.EXECUTED_ACTION, command.control), dtype=np.float64)
        self._fallback.executed(executed)
        self._executed.append(executed)
        return answer

    @property
    def now_s(self) -> float:
        """Seconds of the episode so far, on the clock of control steps."""
        return self._queue.now * self.control_dt

    def _fewest(self, blend_time: float | None, limited: bool) -> int:
        """The fewest control steps of a blend: without a time or a limit, as many as are left over at a seam."""
        if blend_time is None and limited:
            return 0
        rest = (self.chunk_size - 1) * self._apart + 1 - self._delay[1]
        fewest = rest - self.execution_horizon
        if blend_time is not None:
            fewest = max(whole_steps(positive("blend_time", blend_time, "s"), self.control_dt) - 1, 1)
        if fewest < 1 or (fewest >= rest and self.chunk_size > 1):
            raise ConfigurationError(
                f"a blend of {fewest} control steps does not fit into what is left of a chunk when it takes over, "
                f"{rest} control steps: choose a longer chunk_size, a shorter blend_time, or pass rate_limit"
            )
        return fewest

    def _bound_check(self, limits: SeamLimits) -> SeamCheck:
        if not limits.needs_dynamics:
            return SeamCheck(limits, self._controls, self.control_dt)
        plant = self._fallback.plant
        if not isinstance(plant, MujocoPlant):
            plant = MujocoPlant()
            plant.bind(self.env)
        dynamics = InverseDynamics(plant)
        return SeamCheck(limits, self._controls, self.control_dt, dynamics.torques, dynamics.inertia)

    def _checked(self, action: Any) -> Array:
        given, shape = numbers_of(action), (self.chunk_size, self._controls)
        one = given is not None and self.chunk_size == 1 and given.ndim == 1  # an ordinary policy's action
        return action_array(action, shape[1:] if one else shape, np.float64).reshape(shape)

    def _admits(self, commands: Array) -> bool:
        return self._inside is None or self._inside.admits(commands[-1], len(commands))

    def _submit(self, chunk: Array) -> bool:
        """Send the chunk on its way; False if one came and was refused."""
        delay = int(self._random.draw.integers(self._delay[0], self._delay[1] + 1))
        if self._observed_s is None:
            return True
        if not np.isfinite(chunk).all():
            return False
        knots_s, check = self._apart * self.control_dt, self._check
        if check is not None and self._apart > 1 and not check.bears_knots(chunk, knots_s):
            return False
        observed = math.floor(self._observed_s / self.control_dt + SAME_STEP)
        return self._queue.submit(upsampled(chunk, self._apart), observed, self._queue.now + delay)

    def _beyond(self, chunk: Array) -> float:
        """By how much the entry left the action space that left it farthest; the first chunk is warned of."""
        space: Any = self.action_space
        finite = np.where(np.isfinite(chunk), chunk, 0.0)
        beyond = np.clip(finite, space.low, space.high) - finite
        clipped = max(math.hypot(*entry) for entry in beyond)
        if clipped > 0.0:
            message = f"the policy's action left the action space by {clipped:.3g} (action/clipped)"
            self._warn_once("clipped", f"{message}; its entries are clipped to it")
        return clipped

    def _measured(self) -> dict[str, Any]:
        """The info of the control steps since the last call."""
        executed = np.array(self._executed).reshape(-1, self._controls)
        peak = float(np.abs(np.diff(executed, axis=0)).max(initial=0.0)) / self.control_dt
        starved, limited, refused = (
            sum(getattr(command, what) for command in self._commands)
            for what in ("starved", "limited", "refused")
        )
        if limited:
            message = "a command was held back to keep rate_limit: the chunk is too short or fast (handover/limited)"
            self._warn_once("limited", message)
        report = {
            keys.HANDOVER_PEAK_JERK: peak,
            keys.HANDOVER_STARVED: starved,
            keys.HANDOVER_LIMITED: limited,
            keys.HANDOVER_REFUSED: self._refused or refused > 0,
            keys.ACTION_CLIPPED: self._clipped,
        }
        self._executed, self._commands = self._executed[-1:], []
        return report


class ChunkQueue:
    """Which command comes next, counted in control steps.

    A chunk that was observed at step k and is there at step t is consumed from its entry t - k on. A chunk of one has
    no left-over to blend with: only a change to and from the fallback is faded over. `fewest` is of a blend's control
    steps; `rate_limit` of every component, shape (m,), action units per second, infinite for none.
    """

    def __init__(
        self,
        space: gym.spaces.Box,
        control_dt: float,
        blend: str,
        fewest: int,
        rate_limit: Array,
        check: SeamCheck | None = None,
    ) -> None:
        self._control_dt, self._blend, self._fewest = control_dt, blend, fewest
        self._rate_limit, self._check = rate_limit, check
        step = np.asarray(rate_limit * control_dt)
        # The difference of two commands, divided by the interval again, must not come out above the limit.
        self._step = np.where(step / control_dt > rate_limit, np.nextafter(step, 0.0), step)
        self._dtype: Any = np.dtype(space.dtype)
        largest = min(float(np.finfo(self._dtype).max), float(np.finfo(np.float32).max))
        self._low = np.maximum(np.asarray(space.low, np.float64), -largest)
        self._high = np.minimum(np.asarray(space.high, np.float64), largest)
        self.reset()

    def reset(self) -> None:
        """A new episode: nothing sent, nothing planned."""
        self.now = 0
        self._observed = -1
        self._sent = self._plan = np.zeros((0, self._low.size))
        self._limited = np.zeros(0, dtype=bool)
        self._coming: list[Chunk] = []
        self._starved: bool | None = None
        self._fade: tuple[Array, int, int] | None = None  # the latched command, steps, done

    def submit(self, commands: Array, observed: int, due: int) -> bool:
        """A chunk, shape (h, m), observed at a control step, is on its way; False if it is refused.

        Refused are a chunk with an entry that is not finite, and one whose observation is in the future or not newer
        than all before it.
        """
        newest = max([self._observed, *(c.observed for c in self._coming)])
        if not newest < observed <= self.now or not np.isfinite(commands).all():
            return False
        boxed = np.clip(commands, self._low, self._high)
        self._coming.append(Chunk(boxed, observed, due))
        return True

    def next(self, admits: Callable[[Array], bool], fallback: Callable[[], Array]) -> Command:
        """The command of this control step.

        `admits` says whether a chunk may take over, by its commands from now on (h, m); `fallback` is called when
        nothing is planned.
        """
        refused = seam = False
        for chunk in reversed([c for c in self._coming if c.due <= self.now]):
            left = chunk.commands[self.now - chunk.observed :]
            if len(left) and admits(left):
                taken = self._take_over(chunk, left)
                refused |= taken is None
                seam = bool(taken)
                break
            refused = True  # it came too late, or must not
        self._coming = [c for c in self._coming if c.due > self.now]
        starved, limited = not len(self._plan), False
        if starved:
            control = np.clip(fallback(), self._low, self._high)
        else:
            control, limited = self._plan[0], bool(self._limited[0])
            self._plan, self._limited = self._plan[1:], self._limited[1:]
        if starved != self._starved and len(self._sent) and not seam:
            # A longer chunk that takes over blends by itself; everything else starts from the last command.
            self._fade = (self._sent[-1], self._fade_steps(control), 0)
        self._starved = starved
        sent, held = self._sendable(self._faded(control))
        self._sent = np.concatenate([self._sent[-LOOK_BACK + 1 :], sent[None].astype(np.float64)])
        self.now += 1
        return Command(sent, self._observed, starved, held or limited, refused)

    def _take_over(self, chunk: Chunk, fresh: Array) -> bool | None:
        """Let a chunk's rest take over: whether it is a seam; None if no blend keeps the limits."""
        alone = len(chunk.commands) == 1
        joined = Seam(fresh, 0, np.zeros(1, dtype=bool)) if alone else self._joined(fresh)
        if joined is None:
            return None
        self._coming = [c for c in self._coming if c.observed > chunk.observed]
        self._observed = chunk.observed
        self._plan, self._limited = joined.plan, joined.limited
        if alone:
            return False
        self._fade = None
        return len(self._sent) > 0

    def _joined(self, fresh: Array) -> Seam | None:
        """The blend into a chunk's rest, shape (n, m); None if none keeps the machine's limits."""
        return join(
            self._sent,
            self._plan,
            fresh,
            self._control_dt,
            blend=self._blend,
            fewest=self._fewest,
            rate_limit=self._rate_limit,
            low=self._low,
            high=self._high,
            accepts=None if self._check is None else partial(self._check.accepts, self._sent, fresh),
        )

    def _fade_steps(self, target: Array) -> int:
        """Control steps between the latched command and the new one that keep the limits, were both at rest."""
        change = np.abs(target - self._sent[-1])
        shortest = 0.0 if self._check is None else self._check.shortest_fade(change)
        bounded = np.isfinite(self._rate_limit)
        if bounded.any():
            shortest_by_rate = shortest_blend(change[bounded], self._rate_limit[bounded])
            shortest = max(shortest, float(shortest_by_rate.max()))
        return max(self._fewest, whole_steps(shortest, self._control_dt) - 1)

    def _faded(self, control: Array) -> Array:
        if self._fade is None:
            return control
        latched, steps, done = self._fade
        if done >= steps:
            self._fade = None
            return control
        self._fade = (latched, steps, done + 1)
        weight = float(smoothstep((done + 1.0) / (steps + 1.0)))
        return np.asarray(latched + weight * (control - latched))

    def _sendable(self, control: Array) -> tuple[NDArray[Any], bool]:
        """The command in the env's dtype, within the box and the limit, and whether it had to be held back."""
        control = np.clip(control, self._low, self._high)
        if not len(self._sent):
            return control.astype(self._dtype), False
        last = self._sent[-1]
        kept = np.clip(control, last - self._step, last + self._step)
        sent = kept.astype(self._dtype)
        # Rounding alone may break the limit by a hair: one number back, which is not called holding back.
        too_far = np.abs(sent - last) > self._step
        sent = np.where(too_far, np.nextafter(sent, last.astype(self._dtype)), sent)
        hair = 2.0 * float(np.finfo(self._dtype).eps) * np.maximum(np.abs(control), np.abs(last))
        return sent, bool((np.abs(control - kept) > hair).any())


def _sizes(
    chunk_size: Any, execution_horizon: Any, inference_delay: Any, steps_per_entry: Any
) -> tuple[int, int, tuple[int, int], int]:
    """The counts as the user gave them, the delay as least and most, or an error that says what would fit."""
    given = {"chunk_size": chunk_size, "execution_horizon": execution_horizon}
    entries, horizon = (whole_number(name, count, 1, "control steps") for name, count in given.items())
    apart = whole_number("steps_per_entry", steps_per_entry, 1, "control steps")
    if entries == 1 and apart > 1:
        raise ConfigurationError(f"steps_per_entry = {apart}: one entry leads to no other")
    both = inference_delay if isinstance(inference_delay, list | tuple) else [inference_delay] * 2
    delay = tuple(whole_number("inference_delay", one, 0, "control steps") for one in both)
    if len(delay) != 2 or delay[0] > delay[1]:
        raise ConfigurationError(
            f"inference_delay is d control steps or [least, most], got {inference_delay!r}"
        )
    size, most = (entries - 1) * apart + 1, delay[1]
    if not most <= horizon <= size - most:
        has = f"inference_delay d = {most}, execution_horizon s = {horizon}, chunk_size {entries}"
        fits = f"choose s from {max(most, 1)} to {size - most}" if 2 * most < size else "no s fits"
        raise ConfigurationError(f"{has}, H = {size} control steps: d <= s <= H - d must hold; {fits}")
    return entries, horizon, delay, apart


def _rate_limits(rate_limit: Any, controls: int) -> Array:
    """The rate limit of every component, shape (m,), infinite for none."""
    if rate_limit is None:
        return np.full(controls, np.inf)
    each = [positive("rate_limit", one, "action units per second") for one in np.ravel(rate_limit)]
    if len(each) not in (1, controls):
        wanted = f"one number, or one for each of the {controls} action components"
        raise ConfigurationError(f"rate_limit is {wanted}; got {rate_limit!r}")
    return np.array(np.broadcast_to(each, controls))


def upsampled(chunk: Array, steps: int) -> Array:
    """Commands on a cubic Hermite spline through entries (H, m) that lie so many control steps apart.

    Shape ((H - 1) steps + 1, m); at the entries these bit for bit. Between them it may overshoot their range.
    """
    if steps == 1:
        return chunk
    commands = hermite_spline(chunk, float(steps))(np.arange((len(chunk) - 1) * steps + 1.0))
    commands[::steps] = chunk
    return np.asarray(commands)
