"""TeleopChannel: a network between the operator and the machine, and a local brake for when it is too slow."""

import copy
import math
from typing import Any, ClassVar, get_args

import numpy as np
from numpy.typing import NDArray

from safe_wrappers import info as keys
from safe_wrappers.checks import Array, settings_from
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.filter.fallback import FallbackFunction
from safe_wrappers.plants import own_plant
from safe_wrappers.plants.env_checks import refuse_changed_actions
from safe_wrappers.plants.plant import Plant
from safe_wrappers.serialize import plain_data
from safe_wrappers.stack import Layer
from safe_wrappers.wrappers.commands import CommandGate, FallbackController
from safe_wrappers.wrappers.layer import SAME_STEP, Env, Reset, Step, action_array
from safe_wrappers.wrappers.teleop import (
    Line,
    Link,
    RoundTripCeiling,
    RoundTripWatch,
    link_from,
    port_of,
)
from safe_wrappers.wrappers.teleop_coding import Coding, Down, Up, coding_from


class TeleopChannel(CommandGate):
    """Puts a network between the policy, as a remote operator, and the machine.

    `step(action)` sends the action up, executes what has arrived at the machine, sends the observation down, and
    returns the newest that has arrived at the operator. Reward, termination and info are not delayed. With a ceiling,
    the local brake (`fallback`) acts when the round trip is too long for the clearance and approach speed of the
    moment, or when the machine could not stop by itself after the command.

    **What it guarantees.** With a ceiling whose bounds are what they are declared to be, the machine stops inside the
    clearance whatever operator and network do, from a start where it can: proved where the clearance is a distance
    along a line that the brake acts along, best effort elsewhere or with an unverified fallback. With wave coding
    and the effort that the env says, never more energy has come out than went in, less what is in flight.
    **What it does not.** Passivity limits neither force nor displacement. Plain coding bounds no energy.

    Args:
        env: With a one-dimensional Box action space.
        uplink: A `Link` for actions, the dict of one, or a delay in s.
        downlink: For observations, likewise.
        coding: "plain" or "wave".
        impedance: Characteristic impedance b of the waves, N s/m; for "wave".
        ceiling: A `RoundTripCeiling`, the dict of one, or None: authority is never revoked.
        fallback: The local brake: "brake", "hold", "zero", or a function of the plant.
        plant: For the ceiling's constraint and the fallback; None reads the env's MuJoCo model.
        control_dt: Control interval, s; None reads the env's `dt`.

    Info, at every step: ``teleop/round_trip_s``, ``teleop/created_j`` (float), ``teleop/revoked`` (bool),
    ``teleop/lost`` (int); without a filter inside ``executed_action`` and ``action/clipped`` (float).

    Raises:
        ConfigurationError: A link, an impedance or a ceiling that cannot be, or a wrong order.

    Example:
        >>> import gymnasium as gym, numpy as np, safe_wrappers as sw
        >>> env = sw.TeleopChannel(gym.make("TeleopContact-v0"), 0.1, 0.1, coding="wave", impedance=40.0)
        >>> _ = env.reset(seed=0)
        >>> for _ in range(1000):
        ...     info = env.step(np.array([0.1, 0.0]))[4]
        >>> round(info["teleop/round_trip_s"], 3), info["teleop/created_j"] < 1e-8  # float32 actions
        (0.2, True)
    """

    layer: ClassVar = Layer.CHANNEL

    def __init__(
        self,
        env: Env,
        uplink: Link | dict[str, Any] | float,
        downlink: Link | dict[str, Any] | float,
        coding: Coding = "plain",
        impedance: float | None = None,
        ceiling: RoundTripCeiling | dict[str, Any] | None = None,
        fallback: str | FallbackFunction = "brake",
        plant: Plant | None = None,
        control_dt: float | None = None,
    ) -> None:
        arguments = dict(locals())
        CommandGate.__init__(self, env, control_dt)
        plant = own_plant(plant)
        self.uplink, self.downlink = link_from("uplink", uplink), link_from("downlink", downlink)
        limit = None if ceiling is None else settings_from(RoundTripCeiling, ceiling, "ceiling", ", or None")
        if coding not in get_args(Coding):
            raise ConfigurationError(f"coding is one of {', '.join(get_args(Coding))}; got {coding!r}")
        self._record(
            arguments,
            uplink=plain_data(self.uplink),
            downlink=plain_data(self.downlink),
            ceiling=plain_data(limit),
            plant=plant,
        )
        self.port = port_of(env)
        self._coding = coding_from(env, self.port, self.control_dt, coding, impedance)
        self._up = Line(self.uplink, "TeleopChannel up 0", self._same_s)
        self._down = Line(self.downlink, "TeleopChannel down 0", self._same_s)
        self._watch: RoundTripWatch | None = None
        self._fallback: FallbackController | None = None
        if limit is not None:
            self._watch = RoundTripWatch(env, limit, self.control_dt, self._same_s)
            plant = self._watch.budget.plant_of(plant)
            refuse_changed_actions(env)
            self._fallback = FallbackController(env, fallback, plant)
            self._watch.budget.bind(plant)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Reset:
        """Reset the env; nothing is on its way, and the links' random numbers start anew with a seed."""
        self.started = False
        observation, info = self.env.reset(seed=seed, options=options)
        self._up.reset(self.env, seed, first=None)
        self._down.reset(self.env, seed, first=Down(_copy(observation), 0.0, None))
        if self._fallback is not None:
            self._fallback.reset()
        if self._watch is not None:
            self._watch.reset()
        self._coding.reset(observation)
        self._start(info)
        self._lost = 0
        self._images: list[float] = [0.0]  # when the image was taken that was shown after each step
        self._report(info, 0.0)
        self.started = True
        return observation, info

    def step(self, action: Any) -> Step:
        """Send the action, step the env with what has arrived, and return what has come back."""
        self._refuse_without_reset()
        now_s, self._lost = self.now_s, 0
        self._send_up(self._sendable(action), now_s)
        arrived = self._up.receive(now_s)
        command = self._in_force()
        flow, seen_s = self._coding.far(arrived, self._up.newest.load)
        if flow is not None:
            command = self._with_flow(command, flow)
        round_trip_s = now_s - seen_s
        if self._watch is not None:
            self._watch.judge(self._boxed(command), seen_s, round_trip_s, now_s)
        if self.revoked:
            assert self._fallback is not None
            command = self._fallback.command().astype(self._dtype)
        executed, (observation, reward, terminated, truncated, info) = self._execute(command)
        # What the brake or a filter inside does is not the operator's: the channel's port stood still.
        obeyed = not self.revoked and np.array_equal(executed, np.asarray(command, dtype=np.float64))
        shown = self._send_down(executed, observation, obeyed)
        if self._watch is not None:
            self._watch.look()
        self._report(info, round_trip_s)
        return shown, reward, terminated, truncated, info

    @property
    def revoked(self) -> bool:
        """Whether the local brake acted in the last step."""
        return self._watch is not None and self._watch.revoked

    def _sendable(self, action: Any) -> NDArray[Any] | None:
        """The action, inside the space; None, which counts as lost, where it is not finite."""
        given = self._inside(action_array(action, self._shape), "operator's")
        if self._is_finite(given, "operator's", "it is not sent"):
            return given
        self._lost += 1
        return None

    def _send_up(self, action: NDArray[Any] | None, now_s: float) -> None:
        observed_s, self._observed_s = self._observed_s, self.now_s + self.control_dt
        if observed_s is None or observed_s > now_s + self._same_s:
            self._lost += action is not None and observed_s is not None
            action = None
        self._moved = flow = None if action is None else self._flow_of(action)
        extra = self._coding.near(flow)
        if action is None or observed_s is None:
            return
        step = min(max(math.floor(observed_s / self.control_dt + SAME_STEP), 0), len(self._images) - 1)
        sequence, lost = self._up.send(Up(action, self._images[step], extra), now_s)
        self._coding.sent(True, sequence, extra, lost)
        self._lost += lost

    def _in_force(self) -> Any:
        """The command for this step as far as it is plain: the newest that has arrived, at first zero."""
        newest = self._up.newest.load
        if newest is None:
            return self._rest()
        command = newest.action.copy()
        # What is judged is what is executed, by a filter inside too.
        if self._watch is not None and ((command < self._low) | (command > self._high)).any():
            command = self._boxed(command).astype(self._dtype)
        return command

    def _flow_of(self, command: Any) -> Array | None:
        """In the box, as the machine will take it."""
        return None if self.port is None else self._boxed(command)[self.port.flow]

    def _with_flow(self, command: Any, flow: Array) -> Any:
        assert self.port is not None
        whole = np.asarray(command, dtype=np.float64).copy()
        whole[self.port.flow] = flow
        return self._boxed(whole).astype(self._dtype)

    def _send_down(self, executed: Array, observation: Any, obeyed: bool) -> Any:
        """Send the observation, and return the one that the operator sees."""
        now_s, coding = self.now_s, self._coding
        flow = executed[self.port.flow] if self.port is not None else executed
        extra, given = coding.settle(flow, observation, obeyed)
        sequence, lost = self._down.send(Down(_copy(observation), now_s, extra), now_s)
        coding.sent(False, sequence, extra, lost)
        self._lost += lost
        arrived = self._down.receive(now_s)
        newest = self._down.newest.load
        self._images.append(max(self._images[-1], newest.taken_s))
        shown = coding.shown(arrived, _copy(newest.observation))
        if given is not None:
            coding.account(self._moved, shown, given)
        return shown

    def _report(self, info: dict[str, Any], round_trip_s: float) -> None:
        info[keys.TELEOP_ROUND_TRIP_S] = round_trip_s
        info[keys.TELEOP_LOST] = self._lost
        info[keys.TELEOP_REVOKED] = self.revoked
        info[keys.TELEOP_CREATED_J] = self._coding.ledger.created_j


def _copy(observation: Any) -> Any:
    """An env may reuse its arrays, a policy may change them."""
    return observation.copy() if isinstance(observation, np.ndarray) else copy.deepcopy(observation)
