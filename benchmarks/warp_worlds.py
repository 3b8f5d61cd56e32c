"""The decision of `HeadingDriveClearance` for many worlds at once: a kernel of Warp, beside MuJoCo Warp's steps.

    pip install '.[warp]'
    python -m benchmarks.warp_worlds                          # on the CPU: agreement, a closed loop, steps/s
    python -m benchmarks.warp_worlds --worlds 4096 32768      # where CUDA is at hand: steps/s there

The kernel (`benchmarks/warp_kernel.py`) is the library's compiled source, translated. It is compared with Numba's
machine code in the same states, with numbers of 64 and of 32 bits.
"""

import argparse
import time
import warnings
from collections.abc import Callable, Iterator
from typing import Any, Final, NamedTuple

import gymnasium as gym
import mujoco
import mujoco_warp
import numpy as np
import warp as wp

import safe_wrappers as sw
from benchmarks.drivers import DRIVERS
from benchmarks.warp_kernel import Scene, States, WorldFilter, scene
from benchmarks.warp_source import CONSTANTS
from safe_wrappers.checks import Array
from safe_wrappers.control.backup import drive_decision as among

ENV_ID: Final = "SafePointGoal1-v0"
_JITTER: Final = 1e-5  # of a borderline state, in units of the state
_ROOM: Final = [0.0, *np.logspace(-9, -2, 29)]  # m: by how much a refused control is short of room
MARGIN_32_M: Final = 2e-6
"""To add to a constraint's margin where the decision has 32 bits: over three times the most that was ever short."""


def sample(**options: float) -> sw.CBFActionFilter:
    """The protected env, reset."""
    env = sw.protect(gym.make(ENV_ID), **options)
    env.reset(seed=0)
    return env


def _rounded(values: Any) -> Array:
    """To what 32 bits hold: the state of MuJoCo Warp."""
    return np.asarray(values, dtype=np.float32).astype(np.float64)


# Agreement with Numba ------------------------------------------------------------------------------------------


def random_states(n: int, seed: int = 0) -> States:
    """A robot at any speed among eight small discs, often inside one."""
    rng = np.random.default_rng(seed)
    qpos, qvel = rng.uniform(-1, 1, (n, 3)) * [0.1, 0.1, 3.0], rng.uniform(-1, 1, (n, 3)) * [1.0, 1.0, 2.0]
    discs = np.concatenate([rng.uniform(-0.9, 0.9, (n, 8, 2)), np.full((n, 8, 1), 0.1)], axis=2)
    proposals, sides = rng.uniform(-1, 1, (n, 2)), rng.choice([-1.0, 0.0, 1.0], n)
    return States(*map(_rounded, (qpos, qvel, discs, proposals, sides)))


def closed_loop_states(steps: int, seed: int = 0) -> States:
    """States and proposals of the filtered env with drivers that go for hazards, some steps of each."""
    found = []
    for driver in ("hazard-seeking", "bang-bang", "lateral-drift"):
        env = sample()
        env.reset(seed=seed)
        raw, (bound,) = env.unwrapped, env.filter.bound
        room = scene(env).room
        act = DRIVERS[driver](raw, np.random.default_rng(seed))
        for _ in range(steps):
            action = np.asarray(act(), dtype=np.float64)
            discs = np.column_stack([raw.hazard_positions, np.full(len(raw.hazard_positions), room)])
            found.append(
                (raw.data.qpos[:3].copy(), raw.data.qvel[:3].copy(), discs, action, bound._kept_side())
            )
            env.step(action)
    return States(*(_rounded(part) for part in zip(*found, strict=True)))


class Agreement(NamedTuple):
    """Of the kernel with Numba.

    Attributes:
        states: Compared.
        active: Where Numba changes the proposal.
        other_stage: In how many the stage is another one.
        borderline: In how many of these Numba's stage changes, too, if the state is moved by `_JITTER`.
        typical: 99 % of the active controls with the same stage differ by at most this from Numba's in 32 bits.
        largest: All controls with the same stage differ by at most this.
        short_m: The most room, m, that an executed control is short of in 64 bits, from a safe state; where none was
            found, left out.
    """

    states: int
    active: int
    other_stage: int
    borderline: int
    typical: float
    largest: float
    short_m: float


def by_numba(shared: Scene, states: States, i: int) -> tuple[int, Array]:
    """Stage and control of one world; an unresolved one is given the manoeuvre."""
    motion, out = np.concatenate([states.qpos[i], states.qvel[i]]), np.empty(2)
    here = shared.models, motion, states.discs[i], shared.brake, shared.reserve
    stage = among.closest_admitted(
        *here, states.proposals[i], states.sides[i], shared.detour, shared.bounds, out
    )[0]
    if stage == among.UNRESOLVED:
        out[:] = np.clip(among.manoeuvre_drive(*here), shared.bounds[0, 0], shared.bounds[1, 0]), 0.0
    return stage, out


def _is_borderline(shared: Scene, states: States, i: int) -> bool:
    rng, here = np.random.default_rng(i), States(*(part[i : i + 1] for part in states))
    near = [
        here._replace(
            qpos=here.qpos + _JITTER * rng.uniform(-1, 1, 3), qvel=here.qvel + _JITTER * rng.uniform(-1, 1, 3)
        )
        for _ in range(200)
    ]
    return len({by_numba(shared, other, 0)[0] for other in near}) > 1


def _short(shared: Scene, states: States, i: int, control: Any) -> float:
    motion, place = np.empty(6), np.zeros(4)
    scene = shared.models, motion, states.discs[i], shared.brake, shared.reserve
    if among.least_clearance(states.qpos[i], states.qvel[i], place, *scene)[0] < shared.reserve:
        return 0.0  # it has to recover, at a rate
    drive, turn = map(float, control)
    for room in _ROOM:
        discs = states.discs[i] - [0.0, 0.0, room]
        if among.is_admitted(shared.models, motion, discs, shared.brake, shared.reserve, drive, turn):
            return float(room)
    return float("inf")


def agreement(shared: Scene, states: States, kernel: WorldFilter) -> Agreement:
    """Decide all states both ways."""
    stages, controls = kernel.decide(states)
    n = len(stages)
    wanted = [by_numba(shared, states, i) for i in range(n)]
    by_stage = np.array([stage for stage, _ in wanted])
    by_control = np.array([control for _, control in wanted])
    same = stages == by_stage
    apart = np.abs(controls.astype(np.float64) - _rounded(by_control)).max(axis=1)
    changed = by_stage != among.PROPOSAL
    judged = np.flatnonzero(stages != among.UNRESOLVED)
    return Agreement(
        states=n,
        active=int(changed.sum()),
        other_stage=int((~same).sum()),
        borderline=sum(_is_borderline(shared, states, i) for i in np.flatnonzero(~same).tolist()),
        typical=float(np.quantile(apart[same & changed], 0.99)),
        largest=float(apart[same].max()),
        short_m=max(_short(shared, states, i, controls[i]) for i in judged.tolist()),
    )


# MuJoCo Warp ---------------------------------------------------------------------------------------------------


class Worlds:
    """SafePointGoal1 in n worlds of MuJoCo Warp: the env's own model, layouts that it has sampled, drives at random.

    The drives push on, and turn by an amount that each world keeps. Nothing sleeps: on a CPU MuJoCo Warp's sleeping
    makes the step four times as long here.
    """

    def __init__(self, n: int, device: str, real: str = "float64", layouts: int = 64) -> None:
        env = sample()
        rng, found = np.random.default_rng(0), []
        for seed in range(min(n, layouts)):
            env.reset(seed=seed)
            raw = env.unwrapped
            found.append((raw.data.qpos.copy(), raw.data.mocap_pos.copy(), raw.hazard_positions))
        self.scene, self._substeps = scene(env), raw.frame_skip
        qpos, mocap, self.hazards = (
            np.array(part)[np.arange(n) % len(found)] for part in zip(*found, strict=True)
        )
        raw.model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
        room = np.full((*self.hazards.shape[:2], 1), self.scene.room)
        with wp.ScopedDevice(device):
            self.model = mujoco_warp.put_model(raw.model)
            self.data = mujoco_warp.put_data(raw.model, raw.data, nworld=n)
            self.data.qpos.assign(qpos.astype(np.float32))
            self.data.mocap_pos.assign(mocap.astype(np.float32))
            self._discs = wp.array(np.concatenate([self.hazards, room], axis=2), dtype=wp.float32)
            chosen = np.column_stack([np.ones(n), rng.uniform(-1.0, 1.0, n)])
            self.proposals = wp.array(chosen, dtype=wp.float32)
        self.filter = WorldFilter(self.scene, n, self.hazards.shape[1], real, device)

    def launch(self) -> None:
        """Decide in all worlds."""
        d = self.data
        self.filter.launch(d.qpos, d.qvel, self._discs, self.proposals, d.ctrl)

    def step(self, filtered: bool) -> None:
        """One control step of all worlds."""
        if filtered:
            self.launch()
        else:
            wp.copy(self.data.ctrl, self.proposals)
        for _ in range(self._substeps):
            mujoco_warp.step(self.model, self.data)

    def clearance(self) -> Array:
        """Of each robot's centre from the nearest hazard's edge, m, shape (n,)."""
        gaps = self.data.qpos.numpy()[:, None, :2].astype(np.float64) - self.hazards
        return np.linalg.norm(gaps, axis=2).min(axis=1) - 0.2  # type: ignore[no-any-return]


def closed_loop(n: int, steps: int, filtered: bool, real: str, device: str) -> str:
    """A row: the least clearance, worlds that entered a hazard, the share of changed actions, unresolved ones."""
    worlds = Worlds(n, device, real)
    least, changed, unresolved = worlds.clearance(), 0, 0
    for _ in range(steps):
        worlds.step(filtered)
        least = np.minimum(least, worlds.clearance())
        stages = worlds.filter.stages.numpy()
        changed += int((stages != among.PROPOSAL).sum())
        unresolved += int((stages == among.UNRESOLVED).sum())
    inside, share = int((least < 0.0).sum()), changed / (n * steps)
    return f"| {1000 * least.min():.1f} | {inside} of {n} | {share:.0%} | {unresolved} |"


def speeds(n: int, device: str, real: str, steps: int, rounds: int = 5) -> list[float]:
    """Seconds per control step of one world: without the filter, with it, the kernel alone; medians of rounds."""
    worlds = Worlds(n, device, real)
    once: list[Callable[[], None]] = [lambda: worlds.step(False), lambda: worlds.step(True), worlds.launch]
    with wp.ScopedDevice(device):
        for step in once:
            step()  # compiles
        if wp.get_device(device).is_cuda:
            once = [_captured(step) for step in once]
        times: list[list[float]] = [[] for _ in once]
        for _ in range(rounds):
            for way, step in enumerate(once):
                wp.synchronize()
                begin = time.perf_counter()
                for _ in range(steps):
                    step()
                wp.synchronize()
                times[way].append((time.perf_counter() - begin) / (n * steps))
    return np.median(times, axis=1).tolist()


def _captured(step: Callable[[], None]) -> Callable[[], None]:
    with wp.ScopedCapture() as capture:
        step()
    return lambda: wp.capture_launch(capture.graph)


def reports(states: int, seed: int, device: str) -> Iterator[str]:
    columns = (
        "compared | active | other stage | of these borderline | 99 % within | all within | short of room (m)"
    )
    yield f"| states | decision | {columns} |\n|" + "---|" * 9
    kinds = [(real, real, chosen) for real, chosen in CONSTANTS.items()]
    kinds.append(("float32", "float32, tolerance as it is", {}))
    random, driven = random_states(states, seed), closed_loop_states(states // 3, seed)
    for name, found in (("random", random), ("closed loop", driven)):
        for uncertainty in (0.0, 0.2):
            shared = scene(sample(uncertainty=uncertainty))
            for real, said, chosen in kinds:
                kernel = WorldFilter(shared, len(found.qpos), found.discs.shape[1], real, device, chosen)
                a = agreement(shared, found, kernel)
                yield (
                    f"| {name}, uncertainty {uncertainty} | {said} | {a.states:,} | {a.active:,} | {a.other_stage} "
                    f"| {a.borderline} | {a.typical:.0e} | {a.largest:.0e} | {a.short_m:.0e} |"
                )


def main() -> None:
    """Print all tables."""
    warnings.simplefilter("ignore")
    wp.config.quiet = True
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--device", default="cuda:0" if wp.is_cuda_available() else "cpu")
    parser.add_argument("--worlds", type=int, nargs="+", help="4096 32768 on a GPU, 16 64 on a CPU")
    parser.add_argument("--states", type=int, default=6000)
    parser.add_argument("--seed", type=int, default=0, help="of the states")
    parser.add_argument("--steps", type=int, default=10)
    chosen = parser.parse_args()
    for line in reports(chosen.states, chosen.seed, chosen.device):
        print(line, flush=True)
    print("\n| decision | least clearance (mm) | worlds in a hazard | changed | unresolved |\n|" + "---|" * 5)
    for said, real in (("no filter", "float64"), *((real, real) for real in CONSTANTS)):
        print(f"| {said} {closed_loop(64, 200, said != 'no filter', real, chosen.device)}", flush=True)
    print(
        "\n| worlds | decision | steps/s | with the filter | ratio | the kernel alone (us per world) |\n|"
        + "---|" * 6
    )
    on_gpu = wp.get_device(chosen.device).is_cuda
    for n in chosen.worlds or ([4096, 32768] if on_gpu else [16, 64]):
        for real in CONSTANTS:
            bare, both, alone = speeds(n, chosen.device, real, chosen.steps)
            figures = f"{1 / bare:,.0f} | {1 / both:,.0f} | {both / bare:.3f} | {1e6 * alone:.2g}"
            print(f"| {n} | {real} | {figures} |", flush=True)


if __name__ == "__main__":
    main()
