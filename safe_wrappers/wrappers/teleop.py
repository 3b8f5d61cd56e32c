"""TeleopChannel: a network between the operator and the machine, and a local brake for when it is too slow."""

import copy
import math
from collections import deque
from dataclasses import dataclass
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from safe_wrappers import info as keys
from safe_wrappers.control.teleop import ChannelLedger
from safe_wrappers.errors import (
    Array,
    ConfigurationError,
    check_fields,
    non_negative,
    positive,
    settings_from,
)
from safe_wrappers.filter.fallback import FallbackFunction
from safe_wrappers.plants import own_plant
from safe_wrappers.plants.env_checks import refuse_changed_actions
from safe_wrappers.plants.plant import Plant
from safe_wrappers.wrappers.faults import probability
from safe_wrappers.wrappers.layer import SAME_STEP, Env, Step, WrapperRng, action_array
from safe_wrappers.wrappers.stack import Layer
from safe_wrappers.wrappers.stopping import (
    BoundBudget,
    CommandGate,
    FallbackController,
    StoppingBudget,
    bound_plant,
)
from safe_wrappers.wrappers.teleop_coding import Packet, Port, WaveCoding

__all__ = ["Link"]

_RELEASE: Final = 0.8
"""Authority comes back only when the round trip is below this share of the ceiling."""


@dataclass(frozen=True)
class Link:
    """What a network does to packets in one direction, which arrive in the order of sending; plain data.

    Args:
        delay_s: Shortest time that a packet takes, s.
        jitter_s: How much longer it may take by itself, s, uniform; it also waits for those sent before it.
        loss: Probability that a packet is lost, from 0 to 1.

    Raises:
        ConfigurationError: A negative time, a probability outside of 0 to 1.
    """

    delay_s: float = 0.0
    jitter_s: float = 0.0
    loss: float = 0.0

    def __post_init__(self) -> None:
        check_fields(self, non_negative, ["delay_s", "jitter_s"], "s")
        object.__setattr__(self, "loss", probability("loss", self.loss))


class Line:
    """The packets of one direction, with random numbers of their own; times closer than `slack_s` are the same.

    Attributes:
        coming: Those on their way, in the order of sending, each with the time, s, from which it only waits for those
            before it.
        newest: The last one that has arrived.
    """

    def __init__(self, link: Link, stream: str, slack_s: float) -> None:
        self._link, self._slack_s = link, slack_s
        self._random = WrapperRng(stream)

    def reset(self, env: Env, seed: int | None, first: Any = None) -> None:
        """Nothing is on its way, and `first`, made at 0 s, has arrived; call it after the env's own reset."""
        self._random.reset(env, seed)
        self.coming: deque[tuple[float, Packet]] = deque()
        self.newest = Packet(first, 0.0)

    def send(self, packet: Packet, now_s: float) -> bool:
        """Send a packet; whether it gets lost."""
        link = self._link
        # As many numbers for a lost packet as for one that is not: what follows stays the same.
        jitter_s = self._random.draw.uniform(0.0, link.jitter_s) if link.jitter_s else 0.0
        lost = bool(link.loss and self._random.draw.random() < link.loss)
        if not lost:
            self.coming.append((now_s + link.delay_s + jitter_s, packet))
        return lost

    def receive(self, now_s: float) -> list[Packet]:
        """What has arrived since the last call, in the order of arrival."""
        found: list[Packet] = []
        while self.coming and self.coming[0][0] <= now_s + self._slack_s:
            self.newest = self.coming.popleft()[1]
            found.append(self.newest)
        return found


class TeleopChannel(CommandGate):
    """Puts a network between the policy, as a remote operator, and the machine.

    `step(action)` sends the action up, executes what has arrived at the machine, sends the observation down, and
    returns the newest that has arrived at the operator. Reward, termination and info are not delayed. With a budget
    the round trip has a ceiling: the local brake (`fallback`) acts when it is too long for the clearance and approach
    speed of the moment, or when the machine could not stop by itself after the command (`control.watchdog`).

    **What it guarantees.** With a budget whose bounds are what they are declared to be, the machine stops inside the
    clearance whatever operator and network do, from a start where it can: proved where the clearance is a distance
    along a line that the brake acts along, best effort elsewhere or with an unverified fallback. With wave coding
    never more energy has come out than went in, less what is in flight. **What it does not.** Passivity limits
    neither force nor displacement.

    Args:
        env: With a one-dimensional Box action space.
        uplink: A `Link` for actions, the dict of one, or a delay in s.
        downlink: For observations, likewise.
        impedance: Characteristic impedance b of waves, N s/m; None sends flow and effort themselves.
        budget: A `StoppingBudget` or the dict of one, whose clearance is a `Clearance` or a function of the env.
            None: authority is never revoked.
        video_s: Of the budget's ceiling: T_video, exposure, encoding and display, without the downlink, s.
        human_s: Likewise T_human, the operator's reaction, s.
        longest_s: It is never higher, s: an operator who is silent for longer loses authority at rest, too.
        fallback: The local brake: "brake", "hold", "zero", or a function of the plant.
        plant: For the budget's constraint and the fallback; None reads the env's MuJoCo model.

    Info, at every step: ``teleop/round_trip_s``, ``teleop/created_j`` (float), ``teleop/revoked`` (bool),
    ``teleop/lost`` (int); without a filter inside ``executed_action`` and ``action/clipped`` (float).

    Raises:
        ConfigurationError: A link, an impedance, a budget or a time that cannot be, or a wrong order.

    Example:
        >>> import gymnasium as gym, numpy as np, safe_wrappers as sw
        >>> env = sw.TeleopChannel(gym.make("TeleopContact-v0"), 0.1, 0.1, impedance=40.0)
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
        *,
        impedance: float | None = None,
        budget: StoppingBudget | dict[str, Any] | None = None,
        video_s: float = 0.1,
        human_s: float = 0.25,
        longest_s: float = 1.0,
        fallback: str | FallbackFunction = "brake",
        plant: Plant | None = None,
    ) -> None:
        CommandGate.__init__(self, env)
        plant = own_plant(plant)
        self._port = Port(env) if env.has_wrapper_attr("port_flow") else None
        self._waves: WaveCoding | None = None
        if impedance is not None:
            if self._port is None:
                raise ConfigurationError(
                    f"waves need a port: {env.unwrapped!r} publishes no port_flow, port_effort_observed, "
                    "port_feedthrough and port_effort_acted"
                )
            refuse_changed_actions(env)
            self._waves = WaveCoding(self._port, self.control_dt, positive("impedance", impedance, "N s/m"))
        self._up = Line(_link("uplink", uplink), "TeleopChannel up 0", self._same_s)
        self._down = Line(_link("downlink", downlink), "TeleopChannel down 0", self._same_s)
        self._operator_s = non_negative("video_s", video_s, "s") + non_negative("human_s", human_s, "s")
        self._longest_s = positive("longest_s", longest_s, "s")
        self._budget: BoundBudget | None = None
        if budget is not None:
            budget = settings_from(StoppingBudget, budget, "budget", ", or None")
            if not budget.measures_approach:
                raise ConfigurationError(
                    f"{budget.clearance} does not say how fast it is approached: give a Clearance"
                )
            refuse_changed_actions(env)
            plant = bound_plant(env, plant, fallback, budget.clearance)
            self._fallback = FallbackController(env, fallback, plant)
            self._budget = BoundBudget(budget, env, plant)

    def _begin(self, observation: Any, info: dict[str, Any], seed: int | None) -> Any:
        self._up.reset(self.env, seed)
        self._down.reset(self.env, seed, copy.deepcopy(observation))
        observation = super()._begin(observation, info, seed)
        self.revoked, self._revoked_s = False, -math.inf
        if self._budget is not None:
            self._look(self._budget)
        self.ledger = ChannelLedger()
        if self._port is not None:
            self._port.reset(observation)
        if self._waves is not None:
            self._waves.reset()
        self._lost = 0
        self._images = [0.0]  # when the image was taken that was shown after each step
        self._report(info, 0.0)
        return observation

    def step(self, action: Any) -> Step:
        """Send the action, step the env with what has arrived, and return what has come back."""
        self._refuse_without_reset()
        now_s, self._lost = self.now_s, 0
        self._send_up(self._inside(action_array(action, self._shape)), now_s)
        arrived = self._up.receive(now_s)
        command, seen_s = self._in_force(arrived)
        if self._budget is not None:
            self._judge(self._budget, self._boxed(command), seen_s, now_s)
        if self.revoked:
            assert self._fallback is not None
            command = self._fallback.command().astype(self._dtype)
        executed, (observation, reward, terminated, truncated, info) = self._execute(command)
        # What the brake or a filter inside does is not the operator's: the channel's port stood still.
        obeyed = not self.revoked and np.array_equal(executed, np.asarray(command, dtype=np.float64))
        shown = self._send_down(executed, observation, obeyed)
        if self._budget is not None:
            self._look(self._budget)
        self._report(info, now_s - seen_s)
        return shown, reward, terminated, truncated, info

    def _look(self, budget: BoundBudget) -> None:
        """Measure the clearance, and the ceiling: the longest round trip, s, within `longest_s` of 0.

        Where nothing can be read it is the lowest.
        """
        budget.measure()
        highest_s = -math.inf
        if budget.readable:  # the next look comes one control step from now
            highest_s = budget.longest_round_trip(self._operator_s) - self.control_dt
        self._ceiling_s = min(max(highest_s, -self._longest_s), self._longest_s)

    def _judge(self, budget: BoundBudget, command: Array, seen_s: float, now_s: float) -> None:
        """Revoke authority, or give it back, for a command (m,) made from the image that was taken at `seen_s`."""
        allowed_s, since_s = self._ceiling_s, -math.inf
        if self.revoked:
            allowed_s, since_s = min(_RELEASE * allowed_s, allowed_s), self._revoked_s
        in_time = now_s - seen_s <= allowed_s + self._same_s and seen_s >= since_s - self._same_s
        trusted = budget.readable and in_time and budget.can_stop_after(command, self.control_dt)
        if not trusted and not self.revoked:
            self._revoked_s = now_s
        self.revoked = not trusted

    def _send_up(self, action: NDArray[Any] | None, now_s: float) -> None:
        """Send an action; one that is not finite, or from an image that nobody has seen yet, counts as lost."""
        observed_s, self._observed_s = self._observed_s, now_s + self.control_dt
        self._lost += action is None
        if action is not None and (observed_s is None or observed_s > now_s + self._same_s):
            self._lost += observed_s is not None
            action = None
        self._moved: Array | None = None
        if action is not None and self._port is not None:
            self._moved = self._boxed(action)[self._port.flow]  # as the machine will take it
        wave = None if self._waves is None else self._waves.near(self._moved)
        if action is not None and observed_s is not None:
            step = min(max(math.floor(observed_s / self.control_dt + SAME_STEP), 0), len(self._images) - 1)
            self._send(self._up, action, self._images[step], wave)

    def _send(self, line: Line, content: Any, made_s: float, wave: Array | None) -> None:
        energy_j = 0.0 if wave is None or self._waves is None else self._waves.energy(wave)
        self._lost += line.send(Packet(content, made_s, wave, energy_j), self.now_s)

    def _in_force(self, arrived: list[Packet]) -> tuple[Any, float]:
        """The command for this step, at first zero, and when the image was taken that it was made from, s."""
        newest = self._up.newest
        command = self._rest() if newest.content is None else newest.content.copy()
        # What is judged is what is executed, by a filter inside too.
        if self._budget is not None and ((command < self._low) | (command > self._high)).any():
            command = self._boxed(command).astype(self._dtype)
        if self._waves is None:
            return command, newest.made_s
        flow, seen_s = self._waves.far(arrived)
        assert self._port is not None
        whole = np.array(command, dtype=np.float64)
        whole[self._port.flow] = flow
        return self._boxed(whole).astype(self._dtype), seen_s

    def _send_down(self, executed: Array, observation: Any, obeyed: bool) -> Any:
        """Send the observation, and return the one that the operator sees; add up the energies of the tick."""
        port, waves, wave = self._port, self._waves, None
        if port is not None:
            flow = executed[port.flow]
            acted, still = port.acted(flow, observation), np.zeros(flow.size)
            given = (acted, flow) if obeyed else (still, still)
            wave = None if waves is None else waves.settle(*given, obeyed)
        self._send(self._down, copy.deepcopy(observation), self.now_s, wave)
        arrived, newest = self._down.receive(self.now_s), self._down.newest
        self._images.append(newest.made_s)
        shown = copy.deepcopy(newest.content)
        if port is not None:
            shown = shown if waves is None else port.replaced(shown, waves.felt(arrived))
            moved = still if self._moved is None else self._moved
            self.ledger.add(port.of(shown), moved, *given, self.control_dt, self.stored_j)
        return shown

    @property
    def stored_j(self) -> float:
        """Energy of waves on their way, or arrived and not put out yet, J."""
        if self._waves is None:
            return 0.0
        flying = (packet for _, packet in (*self._up.coming, *self._down.coming))
        return math.fsum(packet.energy_j for packet in (*flying, *self._waves.waiting))

    def _report(self, info: dict[str, Any], round_trip_s: float) -> None:
        info[keys.TELEOP_ROUND_TRIP_S] = round_trip_s
        info[keys.TELEOP_LOST] = self._lost
        info[keys.TELEOP_REVOKED] = self.revoked
        info[keys.TELEOP_CREATED_J] = self.ledger.created_j


def _link(name: str, given: Any) -> Link:
    """A link itself, from the dict of one, or with that number of seconds as its delay."""
    if isinstance(given, int | float) and not isinstance(given, bool):
        return Link(delay_s=given)
    return settings_from(Link, given, name, ", or a delay in s")
