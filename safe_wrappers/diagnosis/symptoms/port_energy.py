"""Chatter through delay: energy that comes out of a link between operator and machine, and never went in."""

from dataclasses import fields, replace
from typing import Any

import gymnasium as gym
import numpy as np

from safe_wrappers import info as keys
from safe_wrappers.checks import Array
from safe_wrappers.control.teleop.passivity import ChannelLedger
from safe_wrappers.diagnosis.finding import Evidence
from safe_wrappers.diagnosis.recording import Env, Recording, box
from safe_wrappers.diagnosis.symptom import Measured, NotMeasuredError, Symptom
from safe_wrappers.diagnosis.symptoms.late_commands import ages
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.env_checks import wrappers_of
from safe_wrappers.wrappers.teleop import Link, TeleopPort, port_from
from safe_wrappers.wrappers.teleop_channel import TeleopChannel

_OURS = ("gymnasium.", "safe_wrappers.")
"""Packages whose wrappers are no links, but for `TeleopChannel`."""


def _channel(env: Env) -> TeleopChannel | None:
    return next((one for one in wrappers_of(env) if isinstance(one, TeleopChannel)), None)


def _port(env: Env) -> TeleopPort:
    """What meets the machine: as the channel was told, or as the env publishes it."""
    channel = _channel(env)
    try:
        port = port_from(None, env) if channel is None else channel.port
    except ConfigurationError as error:
        raise NotMeasuredError(str(error)) from error
    if port is None:
        raise NotMeasuredError(
            "the env publishes no port (port_flow, port_effort_observed): nothing says which of its numbers are a "
            "force and a velocity whose product is power"
        )
    return port


def _observed(observations: list[Array | None], entries: list[int]) -> Array:
    """Entries of each step's observation, shape (k, p)."""
    if any(one is None or len(one) <= max(entries) for one in observations):
        raise NotMeasuredError(
            "the port's efforts are entries of a flat observation, which the env does not show"
        )
    return np.array([one[entries] for one in observations if one is not None])


def _acted(recording: Recording, port: TeleopPort, flow: Array) -> Array:
    """The efforts during each step, shape (k, p): as published, else foreseen from those before it."""
    if len(recording.port_efforts):
        return recording.port_efforts
    after = _observed(recording.answered, list(port.effort))
    before = np.concatenate([after[:1], after[:-1]])
    change = np.diff(flow, axis=0, prepend=flow[:1])
    return np.asarray(before + port.feedthrough * change)


def _touches(recording: Recording) -> float:
    """How often two geoms begin to touch, 1/s."""
    before: set[tuple[int, int]] = set()
    found = 0
    for first, pairs in zip(recording.first, recording.contacts, strict=False):
        found += 0 if first else len(pairs - before)
        before = pairs
    return found / max(len(recording.first) * recording.control_dt, 1e-9)


def measure(env: Env, recording: Recording) -> Measured:
    """The most energy that operator and machine together had got out of what is between them, J."""
    port = _port(env)
    entries, flows = list(port.effort), list(port.flow)
    low, high = (end[flows] for end in box(env))
    sent = np.clip(recording.actions[:, flows], low, high)
    made = np.clip(recording.executed[:, flows], low, high)
    made[recording.of_info(keys.TELEOP_REVOKED) > 0.0] = 0.0  # the brake's motion is not the operator's
    felt, acted = _observed(recording.shown, entries), _acted(recording, port, made)
    created, net, ledger = 0.0, np.zeros(len(sent)), ChannelLedger()
    for k, first in enumerate(recording.first):
        ledger = ChannelLedger() if first else ledger
        ledger.add(felt[k], sent[k], acted[k], made[k], recording.control_dt)
        net[k], created = ledger.net_j, max(created, ledger.created_j)
    worked = float(np.abs((felt * sent).sum(axis=1)).sum() * recording.control_dt)
    evidence = [
        Evidence("energy made per second", created / (len(sent) * recording.control_dt), "W"),
        Evidence("work of the operator, either way", worked, "J"),
        Evidence("contacts that begin", _touches(recording), "1/s"),
        Evidence("largest force that acted", float(np.linalg.norm(acted, axis=1).max()), "N"),
    ]
    return Measured(created, np.maximum(-net, 0.0), evidence)


def _delays(env: Env, recording: Recording, port: TeleopPort) -> tuple[float, float]:
    """Usual delays of a link that is not ours, up and down, s."""
    down = replace(
        recording,
        actions=_observed(recording.answered, list(port.effort)),
        executed=_observed(recording.shown, list(port.effort)),
    )
    up_s, down_s = (float(np.nanmedian(ages(env, one))) * recording.control_dt for one in (recording, down))
    return up_s, down_s


def _text(link: Link) -> str:
    """A link as it is typed."""
    other = [
        f"{one.name}={getattr(link, one.name)!r}"
        for one in fields(link)
        if getattr(link, one.name) != one.default
    ]
    only_delay = link == Link(link.delay_s)
    return f"{link.delay_s:.4g}" if only_delay else f"sw.teleop.Link({', '.join(other)})"


def lines(env: Env, recording: Recording) -> tuple[str, str]:
    """The same link with waves, where it is the outermost wrapper."""
    port, outer = _port(env), env
    made = "Passive is not harmless: waves bound neither force nor displacement; a RoundTripCeiling bounds the way."
    effort, flow = (
        np.abs(_acted(recording, port, recording.executed)),
        np.abs(recording.executed[:, port.flow]),
    )
    usual = float(np.median(effort) / max(float(np.median(flow)), 1e-9))
    b = port.feedthrough or usual  # that of the coupling reflects least
    waves = f'coding="wave", impedance={b:.4g}'
    known: Any = f", port=sw.teleop.{port!r}" if not env.has_wrapper_attr("port_flow") else ""
    if isinstance(outer, TeleopChannel):
        if np.isfinite(recording.of_info(keys.TELEOP_CEILING_S)).any():
            return "", f"Give the channel {waves}, beside the ceiling that it has. {made}"
        up, down = _text(outer.uplink), _text(outer.downlink)
    elif isinstance(outer, gym.Wrapper) and not type(outer).__module__.startswith(_OURS):
        try:
            up, down = (_text(Link(delay)) for delay in _delays(env, recording, port))
        except NotMeasuredError:
            return "", f"Put TeleopChannel(env, uplink, downlink, {waves}) in the place of the link. {made}"
        measured = f"This channel stands for {type(outer).__name__}, with the delays that were measured."
        made = f"{measured} {made}"
    else:
        return (
            "",
            f"Code both ends of the link with waves: TeleopChannel(env, uplink, downlink, {waves}). {made}",
        )
    return f"env = sw.TeleopChannel(\n    env.env, {up}, {down}, {waves}{known}\n)", made


SYMPTOM = Symptom(
    "energy made by a late link: contacts that chatter", "section 1.8, passivity and wave variables",
    0.1, "J", ("energy made so far", "J"), measure, lines, policies_only=True,
)  # fmt: skip
