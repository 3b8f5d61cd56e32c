"""TeleopChannel: a network between the operator and the machine, and a local brake for when it is too slow."""

import copy
import math
import warnings
from typing import Any, ClassVar, Final, Literal, SupportsFloat, get_args

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from safe_wrappers import info as keys
from safe_wrappers.control.numerics.running_sum import RunningSum
from safe_wrappers.control.teleop.passivity import ChannelLedger
from safe_wrappers.control.teleop.port_checks import port_energy
from safe_wrappers.control.teleop.wave_line import Rule
from safe_wrappers.errors import ActionError, ConfigurationError
from safe_wrappers.filter.constraint import non_negative, positive
from safe_wrappers.filter.fallback import FallbackFunction
from safe_wrappers.plants.default import default_plant
from safe_wrappers.plants.plant import Plant, check_actions, check_timing, refuse_changed_actions
from safe_wrappers.plants.template import PlantOfSpec, own_plant
from safe_wrappers.stack import Layer, refuse_order
from safe_wrappers.wrappers.cbf_action_filter import is_filtered
from safe_wrappers.wrappers.common.fallback_controller import StandIn
from safe_wrappers.wrappers.common.receiver import CommandReceiver
from safe_wrappers.wrappers.teleop.coding import Coding, Down, PaidCoding, PlainCoding, Up, WaveCoding
from safe_wrappers.wrappers.teleop.link import Line, Link, Packet, link_data, link_from
from safe_wrappers.wrappers.teleop.port import PortReading, TeleopPort, port_data, port_from
from safe_wrappers.wrappers.teleop.round_trip import (
    RoundTripCeiling,
    RoundTripWatch,
    ceiling_data,
    ceiling_from,
)

Array = NDArray[np.float64]

Missing = Literal["hold", "zero", "fallback"]
"""What acts while no command arrives."""
Passivity = Literal["none", "controller"]

_SAME_TIME: Final = 1e-6
"""Control steps: times that are closer are meant to be the same."""

_UNPAID_J: Final = 0.02


class TeleopChannel(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs, CommandReceiver):
    """Puts the policy, as a remote operator, behind a network: actions travel up, observations travel down.

    `step(action)` sends the action, executes what has arrived at the machine, sends the observation back, and
    returns the newest that has arrived at the operator. Reward, termination and info are the trainer's, not the
    operator's: they are not delayed. What the operator knows before anything arrives is the observation of the
    reset, without delay.

    **Plain coding** works with any Box action. Effort and flow then travel as they are, and the delay can create
    energy: the machine bounces between operator and wall. **Wave coding** needs a *port*: the entries of the action
    that are a flow and those of the observation that are its effort (the env publishes them, or `port` says them).
    Each direction carries waves that pay for what they do at the other end (`control.teleop.wave_line`), whatever the
    delay, the jitter and the loss, and the operator's observation shows the effort that is decoded at his end in
    place of the machine's. `passivity="controller"` is the other way to keep a channel from creating energy: plain
    coding, but each end gives out no more than it has heard the other took in (`control.teleop.passivity_control`).

    **The round-trip ceiling.** At every control step the channel measures the round trip: the age of the image that
    the command in force was made from. With a `RoundTripCeiling` it compares it with the longest from which an
    operator could still stop in time, by the clearance and approach speed of this very moment. When the round trip
    is longer, or when the machine could not stop by itself after the command, authority is revoked and the local
    brake (`fallback`) acts. It comes back with a command made from an image taken since, when the round trip is below
    `release` times the ceiling and the machine could stop after it. Meanwhile a wave port stands still and
    swallows the waves: the operator feels a damper of `impedance`, and nothing piles up in the channel.

    On `TeleopContact-v0` a control step is one physics substep, so this is watched at 1 kHz. On an env with longer
    steps it is watched once per step; each decision covers all its substeps: the ceiling is lowered by one step, and
    the local stop is worked out for the end of the step under the declared `acceleration`.

    **What it guarantees.** With a ceiling whose braking, acceleration, top speed, `act_s` and bounds are what they
    are declared to be, the machine stops inside the clearance whatever the operator and the network do, from a start
    where it can: by induction over the control steps, as in `LeaseExpiry`. Where the clearance is a distance along
    a line that the brake acts along (a plane, an axis) that is proved; for a point that passes a corner or a disc
    sideways, or a fallback whose deceleration nobody has verified, it is best effort. With wave coding the energy
    that has come out of the channel at its two ports is never above what went in, less what is in flight, as long as
    the machine's effort is what the port says; what saturation or a wrong `feedthrough` makes of it is in
    `teleop/created_j`. In a step in which the brake acts, or a filter inside changes the action, the channel's port
    counts as still: what these do is their energy. Both hold at once, and both are in the info of every step.

    **What it does not.** Passivity is no limit of force: a tool that hits a wall with stored energy hurts. It bounds
    no displacement either; that is the ceiling's part. The operator is not passive without evidence. Plain coding
    promises nothing of energy. An ideal channel (no delay, plain) changes nothing, bit for bit.

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
        (`control.teleop.wave_line`). port: A `TeleopPort` or the dict of one; None: what the env publishes, if it
        does. damping_limit: Of the passivity controller's damping force at the operator, N; None: none. Damping at a
            small velocity is a large force for one tick.
        storage_j: J that each end of a passivity controller may give out unpaid; None: 0.02. It needs some: an
            operator who feels no force puts no energy in, so nothing would ever move.
        fallback: The local brake: "brake", "hold", "zero", or a function of the plant.
        plant: For the ceiling's constraint and the fallback; None reads the env's MuJoCo model.
        hold_s: Control interval, s; None reads the env's `dt`.
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
        hold_s: float | None = None,
        seed: int = 0,
    ) -> None:
        refuse_order(env, self.layer, type(self).__name__)
        space = check_actions(env)
        plant = own_plant(plant)
        up, down = link_from("uplink", uplink), link_from("downlink", downlink)
        watched = ceiling_from(ceiling)
        for name, given, known in (
            ("coding", coding, Coding),
            ("passivity", passivity, Passivity),
            ("missing", missing, Missing),
            ("wave_rule", wave_rule, Rule),
        ):
            if given not in get_args(known):
                raise ConfigurationError(f"{name} is one of {', '.join(get_args(known))}; got {given!r}")
        if isinstance(seed, bool) or not isinstance(seed, int):
            raise ConfigurationError(f"seed is a whole number, got {seed!r}")
        gym.utils.RecordConstructorArgs.__init__(
            self,
            uplink=link_data(up),
            downlink=link_data(down),
            coding=coding,
            impedance=impedance,
            passivity=passivity,
            ceiling=ceiling_data(watched),
            missing=missing,
            wave_rule=wave_rule,
            port=port_data(port),
            damping_limit=damping_limit,
            storage_j=storage_j,
            fallback=fallback,
            plant=None if plant is None else PlantOfSpec(plant),
            hold_s=hold_s,
            seed=seed,
        )
        gym.Wrapper.__init__(self, env)
        self.hold_s = check_timing(env, hold_s)
        self.uplink, self.downlink = up, down
        self.port = port_from(port, env)
        if passivity == "none" and not (damping_limit is None and storage_j is None):
            raise ConfigurationError('damping_limit and storage_j are for passivity="controller"')
        unpaid = (_UNPAID_J if passivity == "controller" else 0.0) if storage_j is None else storage_j
        self._storage_j = non_negative("storage_j", unpaid, "J")
        self._coding = self._chosen_coding(coding, impedance, passivity, damping_limit, wave_rule)
        slack_s = _SAME_TIME * self.hold_s
        # Two channels, one around the other, are refused; so a number is enough to keep their lines apart.
        self._up = Line(up, f"TeleopChannel up {seed}", slack_s)
        self._down = Line(down, f"TeleopChannel down {seed}", slack_s)
        self._missing: Missing = missing
        self._ceiling = watched
        if watched is not None or missing == "fallback":
            refuse_changed_actions(env)
        if watched is not None and plant is None and not callable(watched.clearance):
            plant = default_plant(env)
        self._stand_in = (
            StandIn(env, fallback, plant) if watched is not None or missing == "fallback" else None
        )
        self._watch = None if watched is None else RoundTripWatch(env, watched, plant, self.hold_s)
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
        for line in (self._up, self._down):
            line.reset(self.env, seed)
        if self._stand_in is not None:
            self._stand_in.reset()
        if self._watch is not None:
            self._watch.reset()
            self._watch.look()
        self._coding.reset(observation)
        self._ledger = ChannelLedger(2.0 * self._storage_j)
        self._energy_in, self._energy_out = RunningSum(), RunningSum()
        self._steps_done = 0
        self._evidence: float | None = 0.0
        self._images: list[float] = [0.0]  # taken when, of the one that was shown after each step
        self._shown: tuple[int, Any] = (-1, _copy(observation))
        self._newest: tuple[int, Up | None] = (-1, None)
        self._revoked_s = -math.inf
        self._revoked = False
        self._lost = self._late = 0
        if not self._filtered:
            info[keys.EXECUTED_ACTION] = np.zeros(self._shape)
        self._report(info, 0.0, self._ceiling_s, self._clearance_m)
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Send the action, step the env with what has arrived, and return what has come back."""
        now_s = self.now_s
        self._lost = self._late = 0
        sendable = self._checked(action)
        self._lost += sendable is None
        self._send_up(sendable, now_s)
        arrived = self._up.arrived(now_s)
        fresh = self._take(arrived)
        command, operators = self._in_force(fresh)
        order = self._coding.far(arrived, self._newest[1], self._flow_of(command) if operators else None)
        if order.flow is not None:
            command, operators = self._with_flow(command, order.flow), True
        round_trip_s = now_s - order.seen_s
        ceiling_s, clearance_m = self._ceiling_s, self._clearance_m
        self._judge(command, order.seen_s, round_trip_s, now_s)
        if self._revoked:
            assert self._stand_in is not None
            command, operators = self._stand_in.command().astype(self._dtype), False
        executed = np.array(command, dtype=np.float64)
        observation, reward, terminated, truncated, info = self.env.step(command)
        if self._filtered:
            executed = np.array(info[keys.EXECUTED_ACTION], dtype=np.float64)
        else:
            info[keys.EXECUTED_ACTION] = executed.copy()
        if self._stand_in is not None:
            self._stand_in.executed(executed)
        self._steps_done += 1
        # What the brake or a filter inside does is not the operator's: the channel's port stood still.
        obeyed = operators and np.array_equal(executed, np.asarray(command, dtype=np.float64))
        shown = self._send_down(executed, observation, obeyed)
        if self._watch is not None:
            self._watch.look()
        self._report(info, round_trip_s, ceiling_s, min(clearance_m, self._clearance_m))
        return shown, reward, terminated, truncated, info

    @property
    def now_s(self) -> float:
        """Seconds of the episode so far, on the clock of control steps."""
        return self._steps_done * self.hold_s

    @property
    def revoked(self) -> bool:
        """Whether the local brake acted in the last step."""
        return self._revoked

    def deliver(self, observed_s: float | None) -> None:
        """Say what the next action is made from; without a word it is made from the newest observation shown.

        Args:
            observed_s: When that observation was returned, s on the clock of `now_s`; the time of its image is the
                channel's to know. None, or a time in the future: there is no operator in the next step.
        """
        if observed_s is not None and not math.isfinite(observed_s):
            raise ActionError(f"observed_s is a time in seconds, or None for nothing; got {observed_s!r}")
        self._evidence = observed_s

    # The operator's end ------------------------------------------------------------------------------------

    def _checked(self, action: Any) -> Array | None:
        """A copy of the action, in its own dtype; None where there is none that could be sent."""
        try:
            given = np.array(action)
            numbers = given.astype(np.float64)
        except (TypeError, ValueError):
            raise ActionError(f"expected an action of shape {self._shape}, got {action!r}") from None
        if given.shape != self._shape:
            raise ActionError(f"expected an action of shape {self._shape}, got shape {given.shape}")
        if not np.isfinite(numbers).all():
            if not self._warned:
                self._warned = True
                warnings.warn(
                    f"the operator's action is not finite ({numbers}); it is not sent",
                    UserWarning,
                    stacklevel=3,
                )
            return None
        return given

    def _send_up(self, action: Array | None, now_s: float) -> None:
        evidence, self._evidence = self._evidence, self.now_s + self.hold_s
        if evidence is None or evidence > now_s + _SAME_TIME * self.hold_s:
            action = None
        self._moved = flow = None if action is None else self._flow_of(action)
        extra = self._coding.near(flow)
        if action is None or evidence is None:
            return
        step = min(max(math.floor(evidence / self.hold_s + _SAME_TIME), 0), len(self._images) - 1)
        sequence, lost = self._up.send(Up(action, self._images[step], extra), now_s)
        self._coding.sent_up(sequence, extra, lost)
        self._lost += lost

    # The machine's end -------------------------------------------------------------------------------------

    def _take(self, arrived: list[Packet]) -> bool:
        """Keep the newest command; whether there is a new one."""
        before = self._newest[0]
        for packet in arrived:
            if packet.sequence > self._newest[0]:
                self._late += self._newest[0] > before  # overtaken within this very step
                self._newest = packet.sequence, packet.load
            else:
                self._late += 1
        return self._newest[0] > before

    def _in_force(self, fresh: bool) -> tuple[Any, bool]:
        """The command for this step as far as it is plain, and whether it is the operator's."""
        newest = self._newest[1]
        if not fresh and self._missing == "fallback":
            assert self._stand_in is not None
            return self._stand_in.command().astype(self._dtype), False
        if newest is None or (not fresh and self._missing == "zero"):
            return np.clip(np.zeros(self._shape), self._low, self._high).astype(self._dtype), True
        command = newest.action.copy()
        # What is judged is what is executed; without a ceiling nothing is judged, and nothing changed.
        if self._watch is not None and ((command < self._low) | (command > self._high)).any():
            command = np.clip(command, self._low, self._high).astype(self._dtype)
        return command, True

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

    def _judge(self, command: Any, seen_s: float, round_trip_s: float, now_s: float) -> None:
        """Revoke authority, or give it back."""
        watch, ceiling = self._watch, self._ceiling
        if watch is None or ceiling is None:
            return
        slack_s = _SAME_TIME * self.hold_s
        allowed_s = watch.ceiling_s
        if self._revoked:
            allowed_s *= ceiling.release if allowed_s > 0.0 else 1.0
        trusted = watch.readable and round_trip_s <= allowed_s + slack_s
        if trusted and self._revoked:
            trusted = seen_s >= self._revoked_s - slack_s
        boxed = np.clip(np.asarray(command, dtype=np.float64), self._low, self._high)
        trusted = trusted and watch.can_stop_after(boxed)
        if not trusted and not self._revoked:
            self._revoked_s = now_s
        self._revoked = not trusted

    # Back at the operator's end ----------------------------------------------------------------------------

    def _send_down(self, executed: Array, observation: Any, obeyed: bool) -> Any:
        now_s, coding = self.now_s, self._coding
        flow = executed[list(self.port.flow)] if self.port is not None else executed
        extra, given = coding.settle(flow, observation, obeyed)
        sequence, lost = self._down.send(Down(_copy(observation), now_s, extra), now_s)
        coding.sent_down(sequence, extra, lost)
        self._lost += lost
        arrived = self._down.arrived(now_s)
        for packet in arrived:
            if packet.sequence > self._shown[0]:
                self._shown = packet.sequence, packet.load.observation
                self._seen_s = packet.load.taken_s
        self._images.append(max(self._images[-1], self._seen_s if self._shown[0] >= 0 else 0.0))
        shown = coding.shown(arrived, _copy(self._shown[1]))
        if given is not None:
            assert self.port is not None
            felt = np.asarray(shown[list(self.port.effort)], dtype=np.float64)
            moved = np.zeros_like(felt) if self._moved is None else self._moved
            self._ledger.add(felt, moved, *given, self.hold_s, coding.stored_j)
            self._energy_in.add(port_energy(felt, moved, self.hold_s))
            self._energy_out.add(port_energy(*given, self.hold_s))
        return shown

    @property
    def _ceiling_s(self) -> float:
        return math.inf if self._watch is None else self._watch.ceiling_s

    @property
    def _clearance_m(self) -> float:
        return math.inf if self._watch is None else self._watch.clearance_m

    def _report(
        self, info: dict[str, Any], round_trip_s: float, ceiling_s: float, clearance_m: float
    ) -> None:
        info[keys.TELEOP_ROUND_TRIP_S] = round_trip_s
        info[keys.TELEOP_CEILING_S] = ceiling_s
        info[keys.TELEOP_CLEARANCE_M] = clearance_m
        info[keys.TELEOP_REVOKED] = self._revoked
        info[keys.TELEOP_ENERGY_IN_J] = self._energy_in.value
        info[keys.TELEOP_ENERGY_OUT_J] = self._energy_out.value
        info[keys.TELEOP_IN_FLIGHT_J] = self._coding.stored_j
        info[keys.TELEOP_CREATED_J] = self._ledger.created_j
        info[keys.TELEOP_LOST] = self._lost
        info[keys.TELEOP_LATE] = self._late

    def _chosen_coding(
        self,
        coding: Coding,
        impedance: float | None,
        passivity: Passivity,
        damping_limit: float | None,
        rule: Rule,
    ) -> PlainCoding:
        if damping_limit is not None:
            damping_limit = positive("damping_limit", damping_limit, "N")
        if coding == "wave" and passivity == "controller":
            raise ConfigurationError(
                'waves pay for their energy already: passivity="controller" is for plain coding'
            )
        if coding == "plain" and impedance is not None:
            raise ConfigurationError(f'impedance is for coding="wave"; got {impedance!r} with plain coding')
        reading = None if self.port is None else PortReading(self.env, self.port)
        if coding == "plain" and passivity == "none":
            return PlainCoding(reading, self.hold_s)
        if reading is None:
            what = 'coding="wave"' if coding == "wave" else 'passivity="controller"'
            raise ConfigurationError(
                f"{what} needs a port, and {self.env.unwrapped!r} publishes none: say which entries of the action "
                'are a flow and which of the observation its effort, port={"flow": [0, 1], "effort": [4, 5]}'
            )
        refuse_changed_actions(self.env)
        if coding == "plain":
            return PaidCoding(reading, self.hold_s, damping_limit, self._storage_j)
        if impedance is None:
            raise ConfigurationError('coding="wave" needs an impedance, in N s/m')
        return WaveCoding(reading, self.hold_s, positive("impedance", impedance, "N s/m"), rule)


def _copy(observation: Any) -> Any:
    """An env may reuse its arrays, a policy may change them."""
    return observation.copy() if isinstance(observation, np.ndarray) else copy.deepcopy(observation)
