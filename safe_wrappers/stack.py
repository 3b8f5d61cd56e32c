"""The legal order of the layers: which wrapper may not be inside which other, why, and what to write instead."""

from enum import Enum, auto
from typing import Any, Final

import gymnasium as gym

from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.env_checks import wrappers_of


class Layer(Enum):
    """What a wrapper of this library does in a stack; its class attribute `layer`."""

    COST = auto()
    OCCLUSION = auto()
    FILTER = auto()
    MAP = auto()
    LEASE = auto()
    CHANNEL = auto()
    ESCAPE = auto()
    OBSERVATION = auto()
    MONITOR = auto()
    ADAPTION = auto()
    OVERLAY = auto()
    RECORDER = auto()
    HANDOVER = auto()
    FAULT = auto()


_UNSEEN: Final = "it would draw nothing of what is outside of it"
_PER_CHUNK: Final = {Layer.HANDOVER: "its step is a whole chunk, not a control step"}
_LAST_WORD: Final = "it changes actions that the filter has checked, and the filter has the last word"
_AGE: Final = "it hands commands over, and the lease must know how old each one is"
_AUTHORITY: Final = "the actions that it draws need authority as the policy's do"
_NETWORK: Final = "it hands commands over, which the channel must do at every control step"

_WRONG_WAY_ROUND: Final = {
    Layer.COST: {Layer.RECORDER: "it would count no cost", Layer.OVERLAY: _UNSEEN, **_PER_CHUNK},
    Layer.OCCLUSION: {
        Layer.FILTER: "the filter reads the estimates, so they must be there before it decides",
        Layer.CHANNEL: "estimates of now would stand beside an image that is delayed",
        Layer.RECORDER: "it would not count what is seen",
        Layer.OVERLAY: _UNSEEN,
        **_PER_CHUNK,
    },
    Layer.FILTER: {
        Layer.RECORDER: "it would see no report of the filter, and count no intervention",
        Layer.OVERLAY: _UNSEEN,
        Layer.OBSERVATION: "it shows what the filter inside of it decides by",
        **dict.fromkeys((Layer.LEASE, Layer.CHANNEL, Layer.ESCAPE, Layer.HANDOVER, Layer.FAULT), _LAST_WORD),
    },
    Layer.MAP: {
        Layer.FAULT: "actions are mapped for the state in which they are executed, and it delays them",
        **_PER_CHUNK,
    },
    Layer.LEASE: {
        Layer.MAP: "its brake is no policy's action, and would be mapped like one",
        Layer.ESCAPE: _AUTHORITY,
        Layer.RECORDER: "it would count no lease that expires",
        Layer.OVERLAY: _UNSEEN,
        **dict.fromkeys((Layer.HANDOVER, Layer.FAULT), _AGE),
    },
    Layer.CHANNEL: {
        Layer.ESCAPE: _AUTHORITY,
        Layer.RECORDER: "it would see no revoked authority",
        Layer.OVERLAY: _UNSEEN,
        **dict.fromkeys((Layer.HANDOVER, Layer.FAULT), _NETWORK),
    },
    Layer.ESCAPE: {
        Layer.RECORDER: "it would count no deadlock",
        Layer.ADAPTION: "it would take a penalty for an action that the policy has not proposed",
        **_PER_CHUNK,
    },
    Layer.OBSERVATION: {
        Layer.CHANNEL: "what the filter sees now would stand beside an image that is delayed",
        **_PER_CHUNK,
    },
    **dict.fromkeys((Layer.MONITOR, Layer.ADAPTION, Layer.OVERLAY, Layer.RECORDER), _PER_CHUNK),
}
"""By the outer layer, then the inner one: why this order is wrong. The reverse is right."""

_LATER: Final = "actions are mapped for the state in which they are executed, and the channel delays them"
_BOTH_END_AUTHORITY: Final = "both decide when a command's authority ends; use one of them"
_NOT_TOGETHER: Final = {
    Layer.COST: {Layer.COST: "this env has a CostFunction already; add up the costs in one function"},
    Layer.OCCLUSION: {Layer.OCCLUSION: "there is an OcclusionPenalty already; give that one all the tracks"},
    Layer.FILTER: {
        Layer.FILTER: "this env is filtered already; constraints compose in one projection, so pass all of them to "
        "one filter: CBFActionFilter(env, [*inner.constraints, more])"
    },
    Layer.MAP: {
        Layer.MAP: "the env's actions are mapped already; use one map",
        Layer.CHANNEL: f"{_LATER}; use one of them",
    },
    Layer.LEASE: dict.fromkeys((Layer.LEASE, Layer.CHANNEL), _BOTH_END_AUTHORITY),
    Layer.CHANNEL: {
        Layer.MAP: f"{_LATER}; use one of them",
        Layer.CHANNEL: "one network is between operator and machine; give one channel all the delay",
        Layer.LEASE: _BOTH_END_AUTHORITY,
    },
    Layer.ADAPTION: {
        Layer.ADAPTION: "the env has an AdaptionPenalty already, whose penalty would be taken twice"
    },
    Layer.OVERLAY: {Layer.OVERLAY: "the frames have an overlay already"},
    Layer.ESCAPE: {Layer.ESCAPE: "both would act in the policy's place; use one"},
    Layer.OBSERVATION: {Layer.OBSERVATION: "the observation shows what the filter decides by already"},
    Layer.HANDOVER: {Layer.HANDOVER: "this env takes chunks already, and a chunk of chunks has no meaning"},
}
"""By the outer layer, then the inner one: why not both."""


def refuse_order(env: gym.Env[Any, Any], layer: Layer, name: str) -> None:
    """Refuse to put a layer, called `name` in messages, around an env with wrappers that must be outside of it."""
    for inner in wrappers_of(env):
        other = getattr(inner, "layer", None)
        if not isinstance(other, Layer):
            continue
        inside = type(inner).__name__
        why = _NOT_TOGETHER.get(layer, {}).get(other)
        if other in _WRONG_WAY_ROUND.get(layer, {}):
            why = f"{_WRONG_WAY_ROUND[layer][other]}; put it outside: {inside}({name}(env, ...), ...)"
        elif layer is Layer.MONITOR and inside == name:
            why = "the outer one would overwrite the info keys of the inner one; use one for everything it watches"
        if why is not None:
            raise ConfigurationError(f"{inside} inside {name}: {why}")
