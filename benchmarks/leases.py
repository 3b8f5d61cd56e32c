"""Leases on a cart that drives at a wall while its policy falls silent: contacts with and without, and how tight.

    python -m benchmarks leases    # 4 x 10,000 episodes, 20 minutes on two cores; goes on where it was stopped

Everything that the formula of a lease counts is real here, in physics steps of 2 ms: readings of the clearance are
`age_s` old and wrong by up to `localisation`; a request to brake takes effect after it has stood for `detect_s`,
`confirm_s` and `act_s`; and a command that nobody renews goes on for ever.

Outages. Speed, clearance, throttle, brakes, errors and all delays are drawn for each episode. The policy knows where
to brake for the wall; its commands are lost in outages (`safe_wrappers.wrappers.faults.Outages`), the same with and
without the lease.

Worst cases. The policy dies right after a lease was granted, with every reading too long by the whole bound, every
delay used up and brakes not a bit better than declared: once under the lease of `control/watchdog.py`, once
under one that is 5 % longer. Clearances are drawn so that a lease is a whole number of control steps, at least 20.
"""

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import Any, NamedTuple
from unittest import mock

import gymnasium as gym
import mujoco
import numpy as np

import safe_wrappers as sw
from benchmarks.tables import CORES, RUNS, keep, markdown, measured, options, total
from safe_wrappers.control.watchdog import longest_lease
from safe_wrappers.errors import Array
from safe_wrappers.wrappers.faults import Outages

PHYSICS_S, SUBSTEPS = 0.002, 10
HOLD_S = SUBSTEPS * PHYSICS_S
BLOCK = 500
"""Episodes of a job."""
LONGEST_EPISODE_S = 20.0
MODES = {
    "no lease": "outages, no lease",
    "lease": "outages, lease",
    "worst": "worst case, lease of the formula",
    "worst, 5 % longer": "worst case, lease 5 % longer",
}
_NOSE = 0.1
"""m, from the cart's origin to its front."""
MODEL = f"""
<mujoco model="cart and wall">
  <option timestep="{PHYSICS_S}" integrator="RK4" gravity="0 0 0"/>
  <worldbody>
    <geom name="wall" type="box" pos="0.5 0 0" size="0.5 1 1"/>
    <body name="cart">
      <joint name="rail" type="slide" axis="1 0 0"/>
      <geom name="hull" type="box" size="{_NOSE} 0.1 0.1" mass="2"/>
    </body>
  </worldbody>
  <actuator><motor joint="rail"/></actuator>
</mujoco>
"""


@dataclass(frozen=True)
class Drive:
    """What an episode is made of; delays are whole physics steps.

    Attributes:
        clearance: True distance to the wall `age_s` before the start, m.
        speed: Towards it then, m/s.
        braking: Deceleration that the cart counts on, m/s^2.
        brakes_better: The true one over that.
        acceleration: At full throttle, m/s^2.
        top_speed: Where the throttle is cut, m/s.
        localisation: Bound on the error of a reading, m.
        margin: Clearance that is to be kept, m.
        longest_s: Cap of a lease.
        run_up: Throttle between the first reading and the start.
        bias: Error of every reading over `localisation`, in [-1, 1]; None: drawn at each.
    """

    clearance: float
    speed: float
    braking: float
    brakes_better: float
    acceleration: float
    top_speed: float
    detect_s: float
    confirm_s: float
    age_s: float
    act_s: float
    localisation: float
    margin: float
    longest_s: float
    run_up: float = 0.0
    bias: float | None = None

    @property
    def to_brake_s(self) -> float:
        """From a request to brake until the brakes hold."""
        return self.detect_s + self.confirm_s + self.act_s

    def way(self, after_s: float) -> float:
        """From a reading to rest if it brakes so long after it, m: by phases, not by the library."""
        speed, top = self.speed, max(self.top_speed, self.speed)
        rising = min(after_s, (top - speed) / self.acceleration) if self.acceleration > 0.0 else after_s
        end = speed + self.acceleration * rising
        rolled = rising * 0.5 * (speed + end) + (after_s - rising) * end
        return rolled + 0.5 * end * end / self.braking + self.localisation + self.margin


def drawn(rng: np.random.Generator, worst: bool) -> Drive:
    """An episode, started where a stop is possible; a third of them roll and have no throttle."""

    def whole(most_s: float) -> float:
        return PHYSICS_S * int(rng.integers(0, round(most_s / PHYSICS_S) + 1))

    speed, rolling = rng.uniform(0.2, 3.0), rng.random() < 1 / 3
    drive = Drive(
        clearance=0.0,
        speed=speed,
        braking=rng.uniform(1.0, 8.0),
        brakes_better=1.0 if worst else rng.uniform(1.0, 1.3),
        acceleration=0.0 if rolling else rng.uniform(0.3, 4.0),
        top_speed=speed + rng.uniform(0.0, 2.0),
        detect_s=whole(0.1),
        confirm_s=whole(0.1),
        age_s=whole(0.15),
        act_s=whole(0.15),
        localisation=rng.uniform(0.0, 0.1),
        margin=0.0 if worst else rng.uniform(0.0, 0.2),
        longest_s=10.0 if worst else rng.uniform(0.1, 2.0),
        run_up=1.0 if worst else 0.0,
        bias=1.0 if worst else None,
    )
    delays = drive.to_brake_s + drive.age_s
    if not worst:
        return replace(drive, clearance=drive.way(delays) + rng.uniform(0.0, 8.0))
    # The reading is too long by the bound, so the true clearance is less by it; 0.05 mm for what the last physics
    # step of braking, which ends at rest and not before, takes more than the formula.
    lease = HOLD_S * int(rng.integers(20, 101))
    return replace(drive, clearance=drive.way(lease + delays) - drive.localisation + 5e-5)


class CartAndWall(gym.Env[Array, Array]):
    """One action in [-1, 1]: throttle, 0 to roll on at the same speed, below 0 a request to brake by as much.

    The observation is the reading: clearance, m, and approach speed, m/s, `age_s` old.
    """

    def __init__(self) -> None:
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
        self.model = mujoco.MjModel.from_xml_string(MODEL)
        self.data = mujoco.MjData(self.model)
        self.dt, self.frame_skip = HOLD_S, SUBSTEPS
        self._mass = float(self.model.body("cart").mass[0])

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Begin the episode of `options["drive"]`."""
        super().reset(seed=seed)
        self.drive: Drive = (options or {})["drive"]
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[0], self.data.qvel[0] = -(_NOSE + self.drive.clearance), self.drive.speed
        self.lowest, self.touched = self.drive.clearance, False
        self._seen: deque[tuple[float, float]] = deque(maxlen=round(self.drive.age_s / PHYSICS_S) + 1)
        self._seen.append(self._state())
        self._wait = round(self.drive.to_brake_s / PHYSICS_S)
        self._throttle, self._request, self._stood = self.drive.run_up, 0.0, 0
        while len(self._seen) < (self._seen.maxlen or 1):
            self._advance()
        self._read()
        return np.array(self._reading), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """One control step; the episode ends at the wall."""
        command = float(action[0])
        self._request = max(-command, 0.0)
        if self._request == 0.0:
            self._throttle = command
        for _ in range(SUBSTEPS):
            self._advance()
        self._read()
        return np.array(self._reading), 0.0, self.touched, False, {"cost": float(self.touched)}

    @property
    def at_rest(self) -> bool:
        """Whether it stands."""
        return bool(abs(self.data.qvel[0]) < 1e-9)

    def reading(self, env: Any) -> tuple[float, float]:
        """Clearance less its reserves, and approach speed, as the cart knows them: what a lease is granted from."""
        gap, speed = self._reading
        return gap - self.drive.localisation - self.drive.margin, speed

    def _advance(self) -> None:
        _, speed = self._state()
        if self._request > 0.0 and self._stood >= self._wait:
            strength = self._request * self.drive.braking * self.drive.brakes_better
            acceleration = -min(strength, speed / PHYSICS_S)
        else:
            room = max(self.drive.top_speed - speed, 0.0) / PHYSICS_S
            acceleration = min(self._throttle * self.drive.acceleration, room)
        self._stood = self._stood + 1 if self._request > 0.0 else 0
        self.data.ctrl[0] = self._mass * acceleration
        mujoco.mj_step(self.model, self.data)
        gap, _ = self._state()
        self.lowest = min(self.lowest, gap)
        self.touched |= gap < 0.0
        self._seen.append(self._state())

    def _state(self) -> tuple[float, float]:
        return -(float(self.data.qpos[0]) + _NOSE), float(self.data.qvel[0])

    def _read(self) -> None:
        gap, speed = self._seen[0]
        share = self.drive.bias if self.drive.bias is not None else float(self.np_random.uniform(-1.0, 1.0))
        self._reading = gap + share * self.drive.localisation, speed


def leased(cart: CartAndWall, drive: Drive) -> sw.LeaseExpiry:
    """The cart under a lease that knows its numbers."""
    bounds = {name: getattr(drive, name) for name in ("braking", "acceleration", "top_speed")}
    budget = sw.StoppingBudget(cart.reading, **bounds, delays_s=drive.to_brake_s + drive.age_s)
    return sw.LeaseExpiry(cart, budget, max_lease_s=drive.longest_s, fallback=lambda plant: [-1.0])


def episode(mode: str, seed: tuple[int, ...]) -> dict[str, Any]:
    """One drive at the wall, until it stands by its own will, touches, or time is up."""
    rng = np.random.default_rng(seed)
    drive, cart = drawn(rng, worst=False), CartAndWall()
    between_s, length_s = rng.uniform(0.3, 2.0), rng.uniform(0.2, 2.0)
    inside: Any = leased(cart, drive) if mode == "lease" else cart
    env = Outages(inside, mean_between_s=between_s, mean_length_s=length_s)
    reading, _ = env.reset(seed=int(rng.integers(2**31)), options={"drive": drive})
    braking, steps, braked = False, 0, 0
    delay = drive.to_brake_s + drive.age_s + 3.0 * HOLD_S
    while steps * HOLD_S < LONGEST_EPISODE_S:
        # Full throttle until the reading says brake: a lease of two control steps would not be left.
        braking |= float(reading[0]) <= replace(drive, speed=float(reading[1])).way(delay)
        reading, _, touched, _, info = env.step(np.array([-1.0 if braking else 1.0]))
        steps += 1
        braked += int(info.get("lease/braking", False))
        if touched or (cart.at_rest and (braking or drive.acceleration == 0.0)):
            break
    arrived = bool(cart.at_rest and braking)
    found = {"contact": cart.touched, "lowest": cart.lowest - drive.margin, "arrived": arrived}
    return found | {"seconds": steps * HOLD_S, "braked": braked, "steps": steps}


def worst_case(longer: float, seed: tuple[int, ...]) -> dict[str, Any]:
    """The policy sends one command and dies."""
    drive, cart = drawn(np.random.default_rng(seed), worst=True), CartAndWall()
    env, steps = leased(cart, drive), 0
    env.reset(options={"drive": drive})
    with mock.patch(
        "safe_wrappers.wrappers.stopping.longest_lease",
        lambda *a, **k: longer * longest_lease(*a, **k),
    ):
        while not (cart.touched or cart.at_rest):
            info = env.step(np.array([1.0]))[4]
            env.set_observation_time(None)
            steps += 1
            if steps == 1 and info["lease/braking"]:
                raise AssertionError("the first command got no lease")
    found = {"contact": cart.touched, "lowest": cart.lowest, "arrived": False}
    return found | {"seconds": steps * HOLD_S, "braked": 0, "steps": steps}


class Job(NamedTuple):
    """A block of episodes."""

    mode: str
    block: int


def run(job: Job) -> dict[str, Any]:
    """All episodes of a block, summed up; the same ones with and without the lease."""
    rows = []
    for k in range(job.block * BLOCK, (job.block + 1) * BLOCK):
        if job.mode.startswith("worst"):
            rows.append(worst_case(1.0 if job.mode == "worst" else 1.05, (1, k)))
        else:
            rows.append(episode(job.mode, (0, k)))
    least = [row["lowest"] for row in rows]
    sums = {"contacts": total(rows, "contact"), "arrived": total(rows, "arrived")}
    sums |= {"steps": total(rows, "steps"), "braked": total(rows, "braked")}
    sums["arrived_s"] = sum(row["seconds"] for row in rows if row["arrived"])
    return job._asdict() | sums | {"episodes": BLOCK, "lowest_m": min(least), "highest_m": max(least)}


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown: one line per mode."""
    lines = []
    for mode, title in MODES.items():
        part = [row for row in rows if row["mode"] == mode]
        count, contacts = total(part, "episodes"), total(part, "contacts")
        lowest = f"{1e3 * min(row['lowest_m'] for row in part):.2f}"
        if mode == "worst":
            lowest += f" to {1e3 * max(row['highest_m'] for row in part):.2f}"
        arrived, arrived_s = total(part, "arrived"), sum(row["arrived_s"] for row in part)
        cells = [title, f"{count:,}", f"{contacts:,} ({contacts / count:.1%})", "-" if contacts else lowest]
        cells += [f"{arrived / count:.1%}", f"{arrived_s / arrived:.2f}"] if arrived else ["-", "-"]
        braked = f"{total(part, 'braked') / total(part, 'steps'):.1%}" if mode == "lease" else "-"
        lines.append([*cells, braked])
    head = "episodes | count | contacts | least clearance over the margin (mm) | arrived"
    return markdown(f"{head} | mean time (s) | braked", lines)


def main() -> None:
    """Run what is missing, print the table."""
    given = options(__doc__, episodes=10_000, workers=CORES)
    blocks = range(math.ceil(given.episodes / BLOCK))
    jobs = [Job(mode, block) for block in blocks for mode in MODES]
    keep("leases", table(measured(RUNS / "leases/leases.jsonl", jobs, run, given.workers)))
