"""The decision of `HeadingDriveClearance` as a kernel of NVIDIA Warp over worlds."""

import importlib.util
import sys
import tempfile
from pathlib import Path
from types import ModuleType
from typing import Any, Final, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

import safe_wrappers as sw
from benchmarks.warp_source import CONSTANTS, ROOTS, TABLES, Translator
from safe_wrappers.checks import Array
from safe_wrappers.control.backup import drive_decision as among

_DETOUR_STEPS: Final = 50  # as in `BoundHeadingDriveClearance`
_HEADER: Final = '''
import math
from typing import Any

import warp as wp

Real = wp.{real}


@wp.func
def smaller(a: Real, b: Real):
    return wp.where(b < a, b, a)  # as Python's min, also where one is not a number


@wp.func
def larger(a: Real, b: Real):
    return wp.where(b > a, b, a)


@wp.func
def log1p(x: Real):
    near = Real(1.0) + x  # Kahan: the rounding of this sum cancels
    if near == Real(1.0):
        return x
    return wp.log(near) * (x / (near - Real(1.0)))


@wp.func
def take_rows(arena: wp.array(dtype=Real), rows: int, columns: int):
    """A table of zeros at the end of what is taken."""
    begin = int(arena[0])
    arena[0] = Real(begin + rows * columns)
    room = wp.array(ptr=arena.ptr + wp.uint64({bytes} * begin), shape=(rows, columns), dtype=Real)
    return room


@wp.func
def take(arena: wp.array(dtype=Real), size: int):
    begin = int(arena[0])
    arena[0] = Real(begin + size)
    room = wp.array(ptr=arena.ptr + wp.uint64({bytes} * begin), shape=(size,), dtype=Real)
    return room


@wp.func
def pair(arena: wp.array(dtype=Real), a: Real, b: Real):
    both = take(arena, 2)
    both[0] = a
    both[1] = b
    return both


@wp.func
def head(values: wp.array(dtype=Real), size: int):
    first = wp.array(ptr=values.ptr, shape=(size,), dtype=Real)
    return first


@wp.func
def head_rows(values: wp.array2d(dtype=Real), size: int):
    first = wp.array(ptr=values.ptr, shape=(size, values.shape[1]), dtype=Real)
    return first
'''

_KERNEL = """
wp.set_module_options({{"enable_backward": False, "fuse_fp": False}})


@wp.kernel
def decide_worlds(
    models: wp.array2d(dtype=Real),
    bounds: wp.array2d(dtype=Real),
    brake: bool,
    reserve: Real,
    detour: bool,
    qpos: wp.array2d(dtype=wp.float32),
    qvel: wp.array2d(dtype=wp.float32),
    discs: wp.array3d(dtype=wp.float32),
    proposals: wp.array2d(dtype=wp.float32),
    sides: wp.array(dtype=wp.float32),
    kept: wp.array(dtype=int),
    ctrl: wp.array2d(dtype=wp.float32),
    stages: wp.array(dtype=int),
):
    world = wp.tid()
    arena = wp.zeros(shape={size}, dtype=Real)
    arena[0] = Real(1.0)
    motion = take(arena, 6)
    motion[2] = Real(qpos[world, 2])
    for j in range(3):
        motion[3 + j] = Real(qvel[world, j])
    near = take_rows(arena, discs.shape[1], 3)
    total = motion[2] + motion[3] + motion[4] + motion[5]
    for i in range(discs.shape[1]):  # seen from the robot: the difference of two places rounds once
        near[i, 0] = Real(discs[world, i, 0]) - Real(qpos[world, 0])
        near[i, 1] = Real(discs[world, i, 1]) - Real(qpos[world, 1])
        near[i, 2] = Real(discs[world, i, 2])
        total += near[i, 0] + near[i, 1] + near[i, 2]
    proposal = pair(arena, Real(proposals[world, 0]), Real(proposals[world, 1]))
    total += proposal[0] + proposal[1]
    if not wp.isfinite(total):
        ctrl[world, 0] = wp.float32(0.0)
        ctrl[world, 1] = wp.float32(0.0)
        stages[world] = {unresolved}
        return
    side = Real(0.0)
    if kept[world] > 0:
        side = Real(sides[world])
    out = take(arena, 2)
    stage, way, normals, offsets = closest_admitted(
        models, motion, near, brake, reserve, proposal, side, detour, bounds, out, arena
    )
    if way != Real(0.0):
        sides[world] = wp.float32(way)
        kept[world] = {detour_steps}
    kept[world] = kept[world] - 1
    if stage == {unresolved} or not wp.isfinite(out[0] + out[1]):
        stage = {unresolved}
        back = manoeuvre_drive(models, motion, near, brake, reserve, arena)
        out[0] = smaller(larger(back, bounds[0, 0]), bounds[1, 0])
        out[1] = Real(0.0)
    ctrl[world, 0] = wp.float32(out[0])
    ctrl[world, 1] = wp.float32(out[1])
    if stage == 0:
        ctrl[world, 0] = proposals[world, 0]
        ctrl[world, 1] = proposals[world, 1]
    stages[world] = stage
"""


def warp_module(source: str, real: str) -> ModuleType:
    """A module of Warp functions and kernels.

    Args:
        source: Translated, and more with the names `Real`, `wp` and those of the functions.
        real: ``float32`` or ``float64``.
    """
    name = f"drive_{real}"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{name}.py"  # Warp reads the source of what it compiles
        path.write_text(_HEADER.format(real=real, bytes=int(real[5:]) // 8) + "\n\n" + source)
        spec = importlib.util.spec_from_file_location(name, path)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        spec.loader.exec_module(module)
    return module


class States(NamedTuple):
    """Of n worlds: qpos and qvel (n, 3), discs (n, k, 3), proposals (n, 2), sides of detours that go on (n,)."""

    qpos: Array
    qvel: Array
    discs: Array
    proposals: Array
    sides: Array


class Scene(NamedTuple):
    """What all worlds share: the body and its uncertainty's corners, bounds of controls as `closest_admitted`'s."""

    models: Array
    bounds: Array
    room: float
    brake: bool
    reserve: float
    detour: bool


def scene(env: sw.CBFActionFilter) -> Scene:
    """Read from an env that `protect` has wrapped and that was reset."""
    (bound,) = env.filter.bound
    (group,) = bound.spec.obstacles
    least, most = bound.plant.acting_range
    low, high = bound.plant.lower, bound.plant.upper
    bounds = np.array([low, high, np.clip(least, low, high), np.clip(most, low, high)])
    room, brake, reserve = group.radius + bound.reserve, bound.spec.brake, bound.reserve
    return Scene(bound.models, bounds, room, brake, reserve, bound.spec.detour)


class WorldFilter:
    """The decision for every world, in one launch.

    Args:
        shared: Of all worlds.
        n: Worlds.
        discs: In each world.
        real: ``float32`` or ``float64``: the numbers of the decision. States and controls have 32 bits.
        device: ``cpu`` or ``cuda:0``.
        constants: Others than `CONSTANTS`.
    """

    def __init__(
        self,
        shared: Scene,
        n: int,
        discs: int,
        real: str = "float64",
        device: str = "cpu",
        constants: dict[str, float] | None = None,
    ) -> None:
        rows = discs * (len(shared.models) - 1)
        size = 57 + 11 * discs + 16 * rows  # each array of the source, in every call
        kernel = _KERNEL.format(size=size, unresolved=among.UNRESOLVED, detour_steps=_DETOUR_STEPS)
        source = Translator(TABLES, CONSTANTS[real] if constants is None else constants)
        self._kernel = warp_module(source.translate(ROOTS) + "\n\n" + kernel, real).decide_worlds
        self._device, self._n = device, n
        number = getattr(wp, real)
        self._shared = [
            wp.array(shared.models, dtype=number, device=device),
            wp.array(shared.bounds, dtype=number, device=device),
            shared.brake,
            shared.reserve,
            shared.detour,
        ]
        self.sides = wp.zeros(n, dtype=wp.float32, device=device)
        self.kept = wp.zeros(n, dtype=int, device=device)
        self.stages = wp.zeros(n, dtype=int, device=device)

    def launch(self, qpos: Any, qvel: Any, discs: Any, proposals: Any, ctrl: Any) -> None:
        """Write what is to be executed into `ctrl`, and the stage of each world into `stages`; arrays of Warp."""
        given = [*self._shared, qpos, qvel, discs, proposals, self.sides, self.kept, ctrl, self.stages]
        wp.launch(self._kernel, dim=self._n, inputs=given, device=self._device)

    def decide(self, states: States) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Stages (n,) and controls (n, 2) for states from outside."""
        arrays = [wp.array(part, dtype=wp.float32, device=self._device) for part in states[:4]]
        self.sides.assign(states.sides.astype(np.float32))
        self.kept.fill_(1)
        ctrl = wp.zeros((self._n, 2), dtype=wp.float32, device=self._device)
        self.launch(*arrays, ctrl)
        return self.stages.numpy(), ctrl.numpy()
