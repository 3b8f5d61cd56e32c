"""The info of many control steps as the info of one step of a chunked policy."""

from collections.abc import Callable
from typing import Any

import numpy as np

from safe_wrappers.info import KEYS

_MERGES: dict[str, Callable[..., Any]] = {
    "sum": np.sum,
    "any": np.any,
    "max": np.max,
    "min": np.min,
    "mean": np.mean,
}


def macro_info(infos: list[dict[str, Any]]) -> dict[str, Any]:
    """The last control step's info, with each key merged as `InfoKey.chunk` says.

    So costs are summed up and no intervention is lost. A key that only some control steps have counts where it is
    there; what is not registered is the last control step's.
    """
    last = infos[-1]
    if len(infos) == 1:
        return last
    merged: dict[str, Any] = {}
    for name, key in KEYS.items():
        values = [i[name] for i in infos if name in i and (not key.where or i.get(key.where))]
        if values and key.chunk in _MERGES:
            value = _MERGES[key.chunk](values, axis=0)
            array = isinstance(values[-1], np.ndarray)
            merged[name] = np.asarray(value, values[-1].dtype) if array else type(values[-1])(value)
    last.update(merged)
    return last
