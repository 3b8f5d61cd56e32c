"""TeleopChannel: a network between the operator and the machine, and a local brake for when it is too slow."""

import copy
import math
import warnings
from typing import Any, ClassVar, Final, Literal, SupportsFloat, get_args

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from safe_wrappers import info as keys
from safe_wrappers.checks import settings_from
from safe_wrappers.control.teleop.wave_line import Rule
from safe_wrappers.deprecation import deprecated_parameters
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.fallback import FallbackFunction
from safe_wrappers.plants.default import PlantTemplate, own_plant
from safe_wrappers.plants.env_checks import check_actions, check_timing, refuse_changed_actions
from safe_wrappers.plants.plant import Plant
from safe_wrappers.serialize import plain_data, recorded
from safe_wrappers.stack import Layer, refuse_order
from safe_wrappers.wrappers.cbf_action_filter import is_filtered
from safe_wrappers.wrappers.common.fallback_controller import FallbackController
from safe_wrappers.wrappers.common.receiver import CommandReceiver, action_array
from safe_wrappers.wrappers.teleop.coding import Coding, Down, Passivity, Up
from safe_wrappers.wrappers.teleop.link import Line, Link, link_from
from safe_wrappers.wrappers.teleop.port import TeleopPort, port_from
from safe_wrappers.wrappers.teleop.round_trip import RoundTripCeiling, RoundTripWatch
from safe_wrappers.wrappers.teleop.wave_coding import coding_from

Array = NDArray[np.float64]

Missing = Literal["hold", "zero", "fallback"]
"""What acts while no command arrives."""

_SAME_TIME: Final = 1e-6
"""Control steps: times that are closer count as the same."""


@deprecated_parameters(renamed={"hold_s": "control_dt"})
class TeleopChannel(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs, CommandReceiver):
    """Puts a network between the policy, as a remote operator, and the machine.

    `step(action)` sends the action up, executes what has arrived at the machine, sends the observation down, and
    returns the newest that has arrived at the operator; at first that of the reset. Reward, termination and info are
    the trainer's: they are not delayed.

    **Plain coding** works with any Box action. Effort and flow travel as they are, and the delay can create energy:
    the machine bounces between operator and wall. **Wave coding** needs a *port*: the entries of the action that are
    a flow and those of the observation that are its effort (the env publishes them, or `port` says them). Each
    direction carries waves that pay for what they do at the other end (`control.teleop.wave_line`), and the
    operator's observation shows the effort that is decoded there in place of the machine's.
    `passivity="controller"` is plain coding in which each end gives out no more energy than it has heard the other
    took in (`control.teleop.passivity_control`).

    **The round-trip ceiling.** At every control step the channel measures the round trip: the age of the image that
    the command in force was made from. When it is longer than the `RoundTripCeiling` of the present clearance and
    approach speed, or when the machine could not stop by itself after the command, authority is revoked and the local
    brake (`fallback`) acts. Authority comes back with a command made from an image taken since, when the round trip
    is below `release` times the ceiling and the machine could stop after it. Meanwhile a wave port stands still and
    swallows the waves: the operator feels a damper of `impedance`. On an env with long control steps the ceiling is
    lowered by one step, and the local stop is worked out for the end of the step.

    **What it guarantees.** With a ceiling whose bounds are what they are declared to be, the machine stops inside the
    clearance whatever the operator and the network do, from a start where it can. Where the clearance is a distance
    along a line that the brake acts along (a plane, an axis) that is proved; for a point that passes a corner or a
    disc sideways, or a fallback whose deceleration nobody has verified, it is best effort. With wave coding the
    energy that has come out of the channel at its two ports is never above what went in, less what is in flight, as
    long as the machine's effort is what the port says; what saturation or a wrong `feedthrough` makes of it is in
    `teleop/created_j`. In a step in which the brake acts, or a filter inside changes the action, the channel's port
    counts as still.

    **What it does not.** Passivity is no limit of force, and bounds no displacement. Plain coding promises nothing of
    energy. An ideal channel (no delay, plain) changes nothing, bit for bit.

    Order: outermost of the layers of control, `CBFActionFilter` inside it; `RecordInterventions` and the faults
    outside.

    Args:
        env: With a one-dimensional Box action space.
        uplink: A `Link` for actions, the dict of one, or a delay in s.
        downlink: For observations, likewise.
        coding: "plain" or "wave".
        impedance: Characteristic impedance b of the waves, N s/m; for "wave". The operator feels a damper of b until
            the first wave is back; b close to the coupling's own damping reflects least.
        passivity: "none", or "controller" with plain coding and a port.
        ceiling: A `RoundTripCeiling`, the dict of one, or None: authority is never revoked.
        missing: What acts while no command has arrived in a control step: "hold" the last one, "zero", or "fallback".
            Before the first one "hold" is zero. The entries of a wave-coded flow follow `wave_rule`.
        wave_rule: "queue", "hold" or "zero": what a wave line puts out when packets are late
            (`control.teleop.wave_line`).
        port: A `TeleopPort` or the dict of one; None: what the env publishes, if it does.
        damping_limit: Of the passivity controller's damping force at the operator, N; None: none.
        storage_j: J that each end of a passivity controller may give out unpaid; None: 0.02. It needs some: an
            operator who feels no force puts no energy in, so nothing would ever move.
        fallback: The local brake: "brake", "hold", "zero", or a function of the plant.
        plant: For the ceiling's constraint and the fallback; None reads the env's MuJoCo model.
        control_dt: Control interval, s; None reads the env's `dt`.
        seed: A number that keeps the random numbers of several channels apart; they start anew with a reset's seed.

    Info, at every step: ``teleop/round_trip_s``, ``teleop/ceiling_s``, ``teleop/clearance_m``,
    ``teleop/energy_in_j``, ``teleop/energy_out_j``, ``teleop/in_flight_j``, ``teleop/created_j`` (float),
    ``teleop/revoked`` (bool), ``teleop/lost``, ``teleop/late`` (int), and ``executed_action``.

    Raises:
        ConfigurationError: A link, a port, an impedance or a ceiling that cannot be, or a wrong order.

    Example:
        >>> import gymnasium as gym, numpy as np, safe_wrappers as sw
        >>> env = sw.TeleopChannel(gym.make("TeleopContact-v0"), 0.1, 0.1, coding="wave", impedance=40.0)
        >>> _ = env.reset(seed=0)
        >>> for _ in range(1000):
        ...     info = env.step(np.array([0.1, 0.0]))[4]
        >>> round(info["teleop/round_trip_s"], 3), info["teleop/created_j"] < 1e-8  # float32 actions
        (0.2, True)

    Change log:
        * v0.1.0: added.
    """

    layer: ClassVar = Layer.CHANNEL

    def __init__(
        self,
        env: gym.Env[Any, Any],
        uplink: Link | dict[str, Any] | float,
        downlink: Link | dict[str, Any] | float,
        coding: Coding = "plain",
        impedance: float | None = None,
        passivity: Passivity = "none",
        ceiling: RoundTripCeiling | dict[str, Any] | None = None,
        missing: Missing = "hold",
        wave_rule: Rule = "queue",
        port: TeleopPort | dict[str, Any] | None = None,
        damping_limit: float | None = None,
        storage_j: float | None = None,
        fallback: str | FallbackFunction = "brake",
        plant: Plant | None = None,
        control_dt: float | None = None,
        seed: int = 0,
    ) -> None:
        arguments = dict(locals())
        refuse_order(env, self.layer, type(self).__name__)
        space = check_actions(env)
        plant = own_plant(plant)
        self.uplink, self.downlink = link_from("uplink", uplink), link_from("downlink", downlink)
        watched = (
            None if ceiling is None else settings_from(RoundTripCeiling, ceiling, "ceiling", ", or None")
        )
        choices = {"coding": Coding, "passivity": Passivity, "missing": Missing, "wave_rule": Rule}
        for name, known in choices.items():
            if arguments[name] not in get_args(known):
                raise ConfigurationError(
                    f"{name} is one of {', '.join(get_args(known))}; got {arguments[name]!r}"
                )
        if isinstance(seed, bool) or not isinstance(seed, int):
            raise ConfigurationError(f"seed is a whole number, got {seed!r}")
        gym.utils.RecordConstructorArgs.__init__(
            self,
            **recorded(
                arguments,
                uplink=plain_data(self.uplink),
                downlink=plain_data(self.downlink),
                ceiling=plain_data(watched),
                port=plain_data(port),
                plant=None if plant is None else PlantTemplate(plant),
            ),
        )
        gym.Wrapper.__init__(self, env)
        self.control_dt = check_timing(env, control_dt)
        self.port = port_from(port, env)
        self._coding = coding_from(
            env, self.port, self.control_dt, coding, impedance, passivity, damping_limit, storage_j, wave_rule
        )
        self._same_s = _SAME_TIME * self.control_dt
        # Two channels, one around the other, are refused; so a number is enough to keep their lines apart.
        self._up = Line(self.uplink, f"TeleopChannel up {seed}", self._same_s)
        self._down = Line(self.downlink, f"TeleopChannel down {seed}", self._same_s)
        self._missing: Missing = missing
        self._watch: RoundTripWatch | None = None
        self._fallback: FallbackController | None = None
        if watched is not None:
            self._watch = RoundTripWatch(env, watched, self.control_dt, self._same_s)
            plant = self._watch.budget.plant_of(plant)
        if watched is not None or missing == "fallback":
            refuse_changed_actions(env)
            self._fallback = FallbackController(env, fallback, plant)
        if self._watch is not None:
            self._watch.budget.bind(plant)
        self._shape, self._dtype = space.shape, space.dtype
        self._low, self._high = (
            np.nan_to_num(np.asarray(end)).astype(np.float64) for end in (space.low, space.high)
        )
        self._filtered = is_filtered(env)
        self._warned = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the env; nothing is on its way, and the links' random numbers start anew with a seed."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._up.reset(self.env, seed, first=None)
        self._down.reset(self.env, seed, first=Down(_copy(observation), 0.0, None))
        if self._fallback is not None:
            self._fallback.reset()
        if self._watch is not None:
            self._watch.reset()
        self._coding.reset(observation)
        self._steps_done = self._lost = 0
        self._observed_s = 0.0
        self._images: list[float] = [0.0]  # when the image was taken that was shown after each step
        if not self._filtered:
            info[keys.EXECUTED_ACTION] = np.zeros(self._shape)
        self._report(info, 0.0, *self._measured)
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Send the action, step the env with what has arrived, and return what has come back."""
        now_s = self.now_s
        self._lost = 0
        self._send_up(self._sendable(action), now_s)
        arrived = self._up.receive(now_s)
        command, operators = self._in_force()
        order = self._coding.far(arrived, self._up.newest.load, self._flow_of(command) if operators else None)
        if order.flow is not None:
            command, operators = self._with_flow(command, order.flow), True
        round_trip_s = now_s - order.seen_s
        ceiling_s, clearance_m = self._measured
        if self._watch is not None:
            boxed = np.clip(np.asarray(command, dtype=np.float64), self._low, self._high)
            self._watch.judge(boxed, order.seen_s, round_trip_s, now_s)
        if self.revoked:
            command, operators = self._braked(), False
        executed = np.array(command, dtype=np.float64)
        observation, reward, terminated, truncated, info = self.env.step(command)
        if self._filtered:
            executed = np.array(info[keys.EXECUTED_ACTION], dtype=np.float64)
        else:
            info[keys.EXECUTED_ACTION] = executed.copy()
        if self._fallback is not None:
            self._fallback.executed(executed)
        self._steps_done += 1
        # What the brake or a filter inside does is not the operator's: the channel's port stood still.
        obeyed = operators and np.array_equal(executed, np.asarray(command, dtype=np.float64))
        shown = self._send_down(executed, observation, obeyed)
        if self._watch is not None:
            self._watch.look()
        self._report(info, round_trip_s, ceiling_s, min(clearance_m, self._measured[1]))
        return shown, reward, terminated, truncated, info

    @property
    def revoked(self) -> bool:
        """Whether the local brake acted in the last step."""
        return self._watch is not None and self._watch.revoked

    def _sendable(self, action: Any) -> NDArray[Any] | None:
        """A copy of the action; None, which counts as lost, where it is not finite."""
        given = action_array(action, self._shape)
        numbers = given.astype(np.float64)
        if np.isfinite(numbers).all():
            return given
        self._lost += 1
        if not self._warned:
            self._warned = True
            warnings.warn(
                f"the operator's action is not finite ({numbers}); it is not sent", UserWarning, stacklevel=3
            )
        return None

    def _send_up(self, action: NDArray[Any] | None, now_s: float) -> None:
        observed_s, self._observed_s = self._observed_s, self.now_s + self.control_dt
        if observed_s is None or observed_s > now_s + self._same_s:
            action = None
        self._moved = flow = None if action is None else self._flow_of(action)
        extra = self._coding.near(flow)
        if action is None or observed_s is None:
            return
        step = min(max(math.floor(observed_s / self.control_dt + _SAME_TIME), 0), len(self._images) - 1)
        sequence, lost = self._up.send(Up(action, self._images[step], extra), now_s)
        self._coding.sent_up(sequence, extra, lost)
        self._lost += lost

    def _in_force(self) -> tuple[Any, bool]:
        """The command for this step as far as it is plain, and whether it is the operator's."""
        newest, fresh = self._up.newest.load, self._up.fresh
        if not fresh and self._missing == "fallback":
            return self._braked(), False
        if newest is None or (not fresh and self._missing == "zero"):
            return np.clip(np.zeros(self._shape), self._low, self._high).astype(self._dtype), True
        command = newest.action.copy()
        # What is judged is what is executed; without a ceiling nothing is judged, and nothing changed.
        if self._watch is not None and ((command < self._low) | (command > self._high)).any():
            command = np.clip(command, self._low, self._high).astype(self._dtype)
        return command, True

    def _braked(self) -> Any:
        assert self._fallback is not None
        return self._fallback.command().astype(self._dtype)

    def _flow_of(self, command: Any) -> Array | None:
        """In the box, as the machine will take it."""
        if self.port is None:
            return None
        return np.clip(np.asarray(command, dtype=np.float64), self._low, self._high)[list(self.port.flow)]

    def _with_flow(self, command: Any, flow: Array) -> Any:
        assert self.port is not None
        whole = np.asarray(command, dtype=np.float64).copy()
        whole[list(self.port.flow)] = flow
        return np.clip(whole, self._low, self._high).astype(self._dtype)

    def _send_down(self, executed: Array, observation: Any, obeyed: bool) -> Any:
        """Send the observation, and return the one that the operator sees."""
        now_s, coding = self.now_s, self._coding
        flow = executed[list(self.port.flow)] if self.port is not None else executed
        extra, given = coding.settle(flow, observation, obeyed)
        sequence, lost = self._down.send(Down(_copy(observation), now_s, extra), now_s)
        coding.sent_down(sequence, extra, lost)
        self._lost += lost
        arrived = self._down.receive(now_s)
        newest = self._down.newest.load
        self._images.append(max(self._images[-1], newest.taken_s))
        shown = coding.shown(arrived, _copy(newest.observation))
        if given is not None:
            coding.account(self._moved, shown, given)
        return shown

    @property
    def _measured(self) -> tuple[float, float]:
        """The ceiling (s) and the clearance (m) of the present state; inf where they are not watched."""
        watch = self._watch
        return (math.inf, math.inf) if watch is None else (watch.ceiling_s, watch.clearance_m)

    def _report(
        self, info: dict[str, Any], round_trip_s: float, ceiling_s: float, clearance_m: float
    ) -> None:
        info[keys.TELEOP_ROUND_TRIP_S] = round_trip_s
        info[keys.TELEOP_CEILING_S] = ceiling_s
        info[keys.TELEOP_CLEARANCE_M] = clearance_m
        info[keys.TELEOP_REVOKED] = self.revoked
        info[keys.TELEOP_ENERGY_IN_J] = self._coding.energy_in.value
        info[keys.TELEOP_ENERGY_OUT_J] = self._coding.energy_out.value
        info[keys.TELEOP_IN_FLIGHT_J] = self._coding.stored_j
        info[keys.TELEOP_CREATED_J] = self._coding.ledger.created_j
        info[keys.TELEOP_LOST] = self._lost
        info[keys.TELEOP_LATE] = self._up.late


def _copy(observation: Any) -> Any:
    """An env may reuse its arrays, a policy may change them."""
    return observation.copy() if isinstance(observation, np.ndarray) else copy.deepcopy(observation)
