"""An example of every fault injector (`safe_wrappers.wrappers.faults`): over the robot itself, and over a lease.

Injectors carry actions and decide nothing: what a policy gives wrongly has to be refused when it is given.
"""

from collections.abc import Callable
from typing import Any

from benchmarks.faults import wrapper_examples
from benchmarks.faults.wrapper_examples import Env
from safe_wrappers.wrappers.faults import FAULTS

_OFTEN = {"mean_between_s": 0.1, "mean_length_s": 0.1}
EXAMPLES: dict[str, dict[str, float]] = {
    "ClockSkew": {"offset_s": -0.05, "drift": 0.01},
    "DroppedRefreshes": {"share": 0.3},
    "FrozenPolicy": _OFTEN,
    "Jitter": {"longest_s": 0.05},
    "Outages": _OFTEN,
    "RepeatedCommands": {"share": 0.3},
}
"""Name -> arguments."""

_INSIDE: dict[str, Callable[[Callable[[Env], Env]], Env]] = {
    "the robot itself": lambda around: around(wrapper_examples.made("", "Reacher-v5")),
    "a lease": lambda around: wrapper_examples.build("LeaseExpiry", "a Clearance", around),
}
CASES = [(name, case) for name in sorted(FAULTS) for case in _INSIDE]


def build(name: str, case: str, around: Callable[[Env], Env], **more: Any) -> Any:
    """The fault of an example, with more arguments; `around` is put around the task first."""
    assert name in EXAMPLES, f"{name} is a fault without an example: add one to EXAMPLES in {__file__}"
    return FAULTS[name](_INSIDE[case](around), **(EXAMPLES[name] | more))
