"""Where MuJoCo keeps the contacts of its data, for compiled code, which cannot ask its Python bindings.

The bindings tell where contacts are while there are some, but not where they will be, nor where their number is.
These places are found once, in data of tiny models with known numbers of contacts; where they are not found, compiled
code reads no contacts.
"""

import ctypes
import functools
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from safe_wrappers.checks import Array

_BEFORE = 128  # bytes before `data.energy` among which the number of contacts is
_AFTER = 64  # bytes from it on among which the address of the contacts is
_FIELDS = ("pos", "frame", "friction", "dim", "geom", "efc_address")  # reals, then ints
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


class _Layout(NamedTuple):
    """Where things are in any data."""

    number: int  # of contacts, in ints from `_BEFORE` bytes before the energy
    arena: int  # the address at which the contacts begin, in words from the energy
    stride: int  # of contacts, bytes
    places: tuple[int, ...]  # of `_FIELDS` in a contact, in bytes


def contact_memory(model: mujoco.MjModel, data: mujoco.MjData) -> ContactMemory | None:
    """Views of the memory of data; None where MuJoCo does not keep its contacts as expected."""
    layout, energy = _layout(), _address(data.energy)
    if layout is None:
        return None
    # Not by the bindings: from 4.0 on they show an empty array that is anywhere while there are no contacts.
    first = int(_view(energy, _AFTER, np.uint64)[layout.arena])
    if data.ncon and first != _address(data.contact.dist):
        return None
    reals = _view(first, int(data.narena) // 8 * 8, np.float64)
    sizes = (8, 8, 8, 4, 4, 4)
    return ContactMemory(
        model._address,
        data._address,
        _view(energy - 8, 8, np.float64),
        data.qpos,
        data.qvel,
        data.qacc,
        data.qacc_warmstart,
        _view(energy - _BEFORE + 4 * layout.number, 4, np.int32),
        reals,
        reals.view(np.int32),
        layout.stride // 8,
        *(place // size for place, size in zip(layout.places, sizes, strict=True)),
    )


@functools.cache
def _layout() -> _Layout | None:
    """Found in tiny models with known numbers of contacts."""
    numbers, arenas = set(range(_BEFORE // 4)), set(range(_AFTER // 8))
    for count in (1, 2, 3, 5):
        model = mujoco.MjModel.from_xml_string(_BALLS.format("".join(map(_BALL.format, range(count)))))
        data = mujoco.MjData(model)
        for step in range(2):  # without contacts, and with them
            if step:
                mujoco.mj_forward(model, data)
            data.time = 0.5 + count
            words = _view(_address(data.energy) - _BEFORE, _BEFORE, np.int32)
            numbers &= set(np.flatnonzero(words == data.ncon).tolist())
            if words[-2:].view(np.float64)[0] != data.time:
                return None
        contact, addresses = data.contact, _view(_address(data.energy), _AFTER, np.uint64)
        first, stride = _address(contact.dist), int(contact.dist.strides[0])
        arenas &= set(np.flatnonzero(addresses == first).tolist())
    if len(numbers) != 1 or len(arenas) != 1 or stride % 8:
        return None
    places = tuple(_address(getattr(contact, name)) - first for name in _FIELDS)
    return _Layout(numbers.pop(), arenas.pop(), stride, places)


def _address(array: NDArray[Any]) -> int:
    return int(array.__array_interface__["data"][0])


def _view(address: int, size: int, kind: Any) -> NDArray[Any]:
    memory: Any = (ctypes.c_char * size).from_address(address)
    return np.asarray(np.frombuffer(memory, kind))
