"""Where MuJoCo keeps the contacts of its data, for compiled code, which cannot ask its Python bindings.

The bindings tell where the contacts and their fields are, but not where their number is. That place is found once,
in data of tiny models with known numbers of contacts; where it is not found, compiled code reads no contacts.
"""

import ctypes
import functools
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import Array

_BEFORE = 128  # bytes before `data.energy` among which the number of contacts is
_BALLS = """<mujoco><worldbody><geom type="plane" size="9 9 1"/><body pos="0 0 .09"><freejoint/>{}</body>
</worldbody></mujoco>"""
_BALL = '<geom type="sphere" size=".1" pos="{} 0 0"/>'


class ContactMemory(NamedTuple):
    """Views of a data's memory, which are valid while it lives.

    `reals` and `ints` are the same memory, from the first contact's distance on; contacts are `stride` reals apart,
    and their fields are at these numbers of reals (`pos`, `frame`, `friction`) and ints (`dim`, `geom`, `row`).
    """

    model: int
    data: int
    time: Array  # shape (1,), s
    qpos: Array
    qvel: Array
    qacc: Array
    warmstart: Array
    number: NDArray[np.int32]  # of contacts, shape (1,)
    reals: Array
    ints: NDArray[np.int32]
    stride: int
    pos: int
    frame: int
    friction: int
    dim: int
    geom: int
    row: int  # first of its rows in the solver, below 0 if it has none


def contact_memory(model: mujoco.MjModel, data: mujoco.MjData) -> ContactMemory | None:
    """Views of the memory of data; None where MuJoCo does not keep its contacts as expected."""
    place, contact, energy = _place_of_number(), data.contact, _address(data.energy)
    first, stride = _address(contact.dist), contact.dist.strides[0]
    if place is None or stride % 8:
        return None
    reals = _view(first, int(data.narena) // 8 * 8, np.float64)
    return ContactMemory(
        model._address,
        data._address,
        _view(energy - 8, 8, np.float64),
        data.qpos,
        data.qvel,
        data.qacc,
        data.qacc_warmstart,
        _view(energy - _BEFORE + 4 * place, 4, np.int32),
        reals,
        reals.view(np.int32),
        stride // 8,
        *((_address(getattr(contact, name)) - first) // 8 for name in ("pos", "frame", "friction")),
        *((_address(getattr(contact, name)) - first) // 4 for name in ("dim", "geom", "efc_address")),
    )


@functools.cache
def _place_of_number() -> int | None:
    """Where the number of contacts is in the data, in ints from `_BEFORE` bytes before the energy."""
    fitting = set(range(_BEFORE // 4))
    for count in (1, 2, 3, 5):
        model = mujoco.MjModel.from_xml_string(_BALLS.format("".join(map(_BALL.format, range(count)))))
        data = mujoco.MjData(model)
        for step in range(2):  # without contacts, and with them
            if step:
                mujoco.mj_forward(model, data)
            data.time = 0.5 + count
            words = _view(_address(data.energy) - _BEFORE, _BEFORE, np.int32)
            fitting &= set(np.flatnonzero(words == data.ncon).tolist())
            if words[-2:].view(np.float64)[0] != data.time:
                return None
    return fitting.pop() if len(fitting) == 1 else None


def _address(array: NDArray[Any]) -> int:
    return int(array.__array_interface__["data"][0])


def _view(address: int, size: int, kind: Any) -> NDArray[Any]:
    memory: Any = (ctypes.c_char * size).from_address(address)
    return np.asarray(np.frombuffer(memory, kind))
