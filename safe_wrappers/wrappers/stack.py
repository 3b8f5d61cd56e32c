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
    LEASE = auto()
    CHANNEL = auto()
    STUCK = auto()
    OBSERVATION = auto()
    MONITOR = auto()
    ADAPTION = auto()
    OVERLAY = auto()
    RECORDER = auto()
    HANDOVER = auto()
    FAULT = auto()


_WATCHED: Final = (Layer.COST, Layer.OCCLUSION, Layer.FILTER, Layer.LEASE, Layer.CHANNEL)
_STEPPED: Final = (Layer.STUCK, Layer.OBSERVATION, Layer.MONITOR)
_TOLD: Final = (Layer.ADAPTION, Layer.OVERLAY, Layer.RECORDER)
_LAST_WORD: Final = "it changes actions that the filter has checked, and the filter has the last word"

_BELONGS_OUTSIDE: Final = (
    (Layer.HANDOVER, (*_WATCHED, *_STEPPED, *_TOLD), "its step is a whole chunk, not a control step"),
    (Layer.RECORDER, (*_WATCHED, Layer.STUCK), "it would count nothing of what is outside of it"),
    (Layer.OVERLAY, _WATCHED, "it would draw nothing of what is outside of it"),
    (Layer.OBSERVATION, (Layer.FILTER,), "it shows what the filter inside of it decides by"),
    *((layer, (Layer.FILTER,), _LAST_WORD) for layer in (Layer.LEASE, Layer.CHANNEL, Layer.FAULT)),
    (
        Layer.FILTER,
        (Layer.OCCLUSION,),
        "the filter reads the estimates, so they must be there before it decides",
    ),
    (Layer.FAULT, (Layer.LEASE, Layer.CHANNEL), "it hands commands over, which the others must time"),
    (
        Layer.CHANNEL,
        (Layer.OCCLUSION, Layer.OBSERVATION),
        "what is seen now would stand beside a delayed image",
    ),
    (Layer.ADAPTION, (Layer.STUCK,), "its penalties would be taken for a lack of progress"),
)
"""A layer, those that may not be outside of it, and why. The reverse is right."""

_BOTH_END_AUTHORITY: Final = "both decide when a command's authority ends; use one of them"
_NOT_TOGETHER: Final = {
    frozenset({Layer.COST}): "this env has a CostFunction already; add up the costs in one function",
    frozenset({Layer.OCCLUSION}): "there is an OcclusionPenalty already; give that one all the tracks",
    frozenset(
        {Layer.FILTER}
    ): "this env is filtered already; constraints compose in one projection, so pass all of "
    "them to one filter: CBFActionFilter(inner.env, [*inner.constraints, more]), with discrete actions ActionShield",
    frozenset({Layer.LEASE}): _BOTH_END_AUTHORITY,
    frozenset({Layer.LEASE, Layer.CHANNEL}): _BOTH_END_AUTHORITY,
    frozenset({Layer.CHANNEL}): "one network is between operator and machine; give one channel all the delay",
    frozenset({Layer.ADAPTION}): "the env has an AdaptionPenalty already, whose penalty would be taken twice",
    frozenset({Layer.OVERLAY}): "the frames have an overlay already",
    frozenset({Layer.STUCK}): "the outer one would overwrite the info key of the inner one",
    frozenset({Layer.OBSERVATION}): "the observation shows what the filter decides by already",
    frozenset({Layer.HANDOVER}): "this env takes chunks already, and a chunk of chunks has no meaning",
}
"""By one layer or two: why not both."""


def refuse_order(env: gym.Env[Any, Any], layer: Layer, name: str) -> None:
    """Refuse to put a layer, called `name` in messages, around an env with wrappers that must be outside of it."""
    for inner in wrappers_of(env):
        other = getattr(inner, "layer", None)
        if not isinstance(other, Layer):
            continue
        inside = type(inner).__name__
        why = _NOT_TOGETHER.get(frozenset({layer, other}))
        if layer is Layer.MONITOR and inside == name:
            why = "the outer one would overwrite the info keys of the inner one; use one for everything it watches"
        for one, outer, reason in _BELONGS_OUTSIDE:
            if one is other and layer in outer:
                why = f"{reason}; put it outside: {inside}({name}(env, ...), ...)"
        if why is not None:
            raise ConfigurationError(f"{inside} inside {name}: {why}")
