"""ChunkHandover: from the chunks of a policy to one stream of commands with a bounded rate."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np

from safe_wrappers import info as keys
from safe_wrappers.checks import OF_NUMBERS, Array, numbers_of, settings_from, shown
from safe_wrappers.control.handover import BLENDS, SeamCheck, SeamLimits
from safe_wrappers.errors import ActionError, UnknownNameError
from safe_wrappers.filter.fallback import FallbackFunction
from safe_wrappers.plants import own_plant
from safe_wrappers.plants.env_checks import check_actions, check_timing
from safe_wrappers.plants.mujoco.dynamics import InverseDynamics
from safe_wrappers.plants.mujoco.plant import MujocoPlant
from safe_wrappers.plants.plant import Plant
from safe_wrappers.serialize import plain_data, plain_numbers
from safe_wrappers.stack import Layer
from safe_wrappers.wrappers.chunk_queue import (
    ChunkQueue,
    ChunkSizes,
    Command,
    Upsampling,
    blend_bounds,
)
from safe_wrappers.wrappers.commands import FallbackController
from safe_wrappers.wrappers.layer import (
    SAME_STEP,
    CommandReceiver,
    Env,
    LayerWrapper,
    Reset,
    Step,
    WrapperRng,
    receiver_inside,
)


class ChunkHandover(LayerWrapper, CommandReceiver):
    """Executes action chunks that come late, over seams that keep a rate limit.

    The action space becomes the chunk, shape (H, m). One `step(chunk)` is `execution_horizon` control steps (fewer
    where the episode ends); rewards are summed up. A chunk's entry j is meant for the j-th control step after its
    observation; with an `inference_delay` of d it takes over at its entry d, over a blend. Without a left-over of
    the chunk before the fallback acts. With `chunk_size=1, execution_horizon=1` it takes actions (m,), too.

    **What it guarantees.** With `rate_limit`, the commands that it sends in neighbouring control steps of an episode
    differ by at most `rate_limit` times the control interval in every component, whatever the chunks; commands that
    are held back for it are counted (`handover/limited`). A chunk with an entry that is not finite is refused as a
    whole. Entries outside the action box are clipped to it. **What it does not.** A filter
    inside may have to break the limit. It does not check that a chunk is safe: `LeaseExpiry` and `CBFActionFilter`
    belong inside.

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
        control_dt: Control interval, s; None reads the env's `dt`.
        steps_per_entry: Control steps from one entry of a chunk to the next, with a cubic Hermite spline between.
        limits: Of the machine, which every "quintic" keeps between its ends, too: it is stretched until it does, or
            its chunk is refused.

    Info, at every step (see `safe_wrappers.info`): ``handover/peak_jerk``, ``handover/starved``,
    ``handover/limited``, ``handover/refused``, ``action/clipped``. The inner layers' info is merged
    over the control steps.

    Raises:
        ConfigurationError: Sizes that do not fit together, a time or limit that is not positive, nothing to blend
            over.
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

    _executed: list[Array]

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
        control_dt: float | None = None,
        steps_per_entry: int = 1,
        limits: SeamLimits | Mapping[str, Any] | None = None,
    ) -> None:
        arguments = dict(locals())
        LayerWrapper.__init__(self, env)  # first: with a handover inside the actions are no vector either
        space = check_actions(env)
        plant = own_plant(plant)
        sizes = ChunkSizes.checked(chunk_size, execution_horizon, inference_delay, steps_per_entry)
        if blend not in BLENDS:
            raise UnknownNameError(f"no blend {blend!r}; choose {', '.join(BLENDS)}")
        limits = None if limits is None else settings_from(SeamLimits, limits, "limits")
        blend_time, rate_limit, control_dt = map(plain_numbers, (blend_time, rate_limit, control_dt))
        self._record(
            arguments,
            chunk_size=sizes.entries,
            execution_horizon=sizes.horizon,
            inference_delay=sizes.delay[0] if sizes.delay[0] == sizes.delay[1] else list(sizes.delay),
            blend_time=blend_time,
            rate_limit=rate_limit,
            plant=plant,
            control_dt=control_dt,
            steps_per_entry=sizes.steps_per_entry,
            limits=plain_data(limits),
        )
        self.chunk_size, self.execution_horizon, self.blend = sizes.entries, sizes.horizon, blend
        self.control_dt = check_timing(env, control_dt)
        self._delay = sizes.delay
        self._upsampling = Upsampling(sizes.entries, sizes.steps_per_entry)
        self._controls = space.shape[0]
        low, high = (np.repeat(end[None], sizes.entries, axis=0) for end in (space.low, space.high))
        self.action_space = gym.spaces.Box(low, high, dtype=space.dtype)
        self._fallback = FallbackController(env, fallback, plant)
        bounds = blend_time, rate_limit, limits
        fewest, rate_limits = blend_bounds(sizes, space, self.control_dt, blend, *bounds)
        self._check = None if limits is None else self._bound_check(limits)
        self._queue = ChunkQueue(space, self.control_dt, blend, fewest, rate_limits, self._check)
        self._inside = receiver_inside(env)
        self._random = WrapperRng(type(self).__name__)
        self._start()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Reset:
        """Reset the env and forget all chunks; the delays' random numbers start anew with a seed."""
        self.started = False
        observation, info = self.env.reset(seed=seed, options=options)
        self._random.reset(self.env, seed)
        self._fallback.reset()
        self._queue.reset()
        self._start()
        info.update(self._measured([], False, 0.0))
        self.started = True
        return observation, info

    def step(self, action: Any) -> Step:
        """Execute the next `execution_horizon` control steps, with this chunk from when it is there."""
        self._refuse_without_reset()
        chunk = self._checked(action)
        clipped = self._clipped(chunk)
        refused = not self._submit(chunk)
        total: Any = 0.0
        infos, commands = [], []
        terminated = truncated = False
        for _ in range(self.execution_horizon):
            command = self._queue.next(self._admits, self._fallback.command)
            refused |= command.refused
            if self._inside is not None:
                observed_s = None if command.observed < 0 else command.observed * self.control_dt
                self._inside.set_observation_time(observed_s)
            observation, reward, terminated, truncated, info = self.env.step(command.control)
            executed = np.array(info.get(keys.EXECUTED_ACTION, command.control), dtype=np.float64)
            self._fallback.executed(executed)
            self._executed.append(executed)
            total += float(reward)
            infos.append(dict(info))  # the env may use the same one again
            commands.append(command)
            if terminated or truncated:
                break
        self._observed_s = self.now_s
        info = keys.merged(infos)
        info.update(self._measured(commands, refused, clipped))
        return observation, total, terminated, truncated, info

    @property
    def now_s(self) -> float:
        """Seconds of the episode so far, on the clock of control steps."""
        return self._queue.now * self.control_dt

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
        expected = f"expected a chunk of shape {self.action_space.shape}"
        given = numbers_of(action)
        if given is None:
            raise ActionError(f"{expected}, {OF_NUMBERS}, got {shown(action)}")
        chunk = given.astype(np.float64)
        if self.chunk_size == 1 and chunk.shape == (self._controls,):
            return chunk[None]  # an ordinary policy's action
        if chunk.shape != self.action_space.shape:
            raise ActionError(f"{expected} (chunk_size, controls), got {chunk.shape}")
        return chunk

    def _admits(self, commands: Array) -> bool:
        return self._inside is None or self._inside.admits(commands[-1], len(commands))

    def _submit(self, chunk: Array) -> bool:
        """Send the chunk on its way; False if one came and was refused."""
        delay = int(self._random.draw.integers(self._delay[0], self._delay[1] + 1))
        if self._observed_s is None:
            return True
        if not np.isfinite(chunk).all():
            return False
        observed = math.floor(self._observed_s / self.control_dt + SAME_STEP)
        if self._check is not None and not self._upsampling.bears_knots(chunk, self._check, self.control_dt):
            return False
        return self._queue.submit(self._upsampling.commands(chunk), observed, self._queue.now + delay)

    def _start(self) -> None:
        self._observed_s = 0.0
        self._executed = []

    def _clipped(self, chunk: Array) -> float:
        """By how much the entry left the action space that left it farthest; the first chunk is warned of."""
        space: Any = self.action_space
        finite = np.where(np.isfinite(chunk), chunk, 0.0)
        beyond = np.clip(finite, space.low, space.high) - finite
        clipped = max(math.hypot(*entry) for entry in beyond)
        if clipped > 0.0:
            message = f"the policy's action left the action space by {clipped:.3g} (action/clipped)"
            self._warn_once("clipped", f"{message}; its entries are clipped to it")
        return clipped

    def _measured(self, commands: list[Command], refused: bool, clipped: float) -> dict[str, Any]:
        executed = np.array(self._executed).reshape(-1, self._controls)
        peak = float(np.abs(np.diff(executed, axis=0)).max(initial=0.0)) / self.control_dt
        self._executed = self._executed[-1:]
        limited = sum(c.limited for c in commands)
        if limited:
            message = "a command was held back to keep rate_limit: the chunk is too short or fast (handover/limited)"
            self._warn_once("limited", message)
        return {
            keys.HANDOVER_PEAK_JERK: peak,
            keys.HANDOVER_STARVED: sum(c.starved for c in commands),
            keys.HANDOVER_LIMITED: limited,
            keys.HANDOVER_REFUSED: refused,
            keys.ACTION_CLIPPED: clipped,
        }
