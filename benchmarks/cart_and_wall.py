"""A cart on a rail that drives at a wall, late to see and late to brake: where leases are put to the test.

Everything that the formula of a lease counts is real here, in physics steps of 2 ms: readings of the clearance are
`age_s` old and wrong by up to `localisation`; a request to brake takes effect after it has stood for `detect_s`,
`confirm_s` and `act_s`, and until then the last drive command goes on; and a command that nobody renews goes on for
ever. What it does in each step is integrated exactly (constant force, RK4).
"""

from collections import deque
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

from safe_wrappers.checks import Array

PHYSICS_S = 0.002
SUBSTEPS = 10
HOLD_S = SUBSTEPS * PHYSICS_S
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
    """What an episode is made of.

    Attributes:
        clearance: True distance to the wall `age_s` before the start, m.
        speed: Towards it then, m/s.
        braking: Deceleration that the cart counts on, m/s^2.
        brakes_better: The true one over that.
        acceleration: At full throttle, m/s^2.
        top_speed: Where the throttle is cut, m/s.
        detect_s: Delays, whole physics steps.
        confirm_s: Likewise.
        age_s: Likewise.
        act_s: Likewise.
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


class CartAndWall(gym.Env[Array, Array]):
    """One action in [-1, 1]: throttle, 0 to roll on at the same speed, below 0 a request to brake by as much.

    The observation is the reading: clearance and approach speed, `age_s` old.
    """

    def __init__(self) -> None:
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
        self.model = mujoco.MjModel.from_xml_string(MODEL)
        self.data = mujoco.MjData(self.model)
        self.dt, self.frame_skip = HOLD_S, SUBSTEPS
        self._mass = float(self.model.body("cart").mass[0])
        self._start: Drive | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
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
        return self._observation(), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """One control step; the episode ends at the wall."""
        command = float(action[0])
        self._request = max(-command, 0.0)
        if self._request == 0.0:
            self._throttle = command
        for _ in range(SUBSTEPS):
            self._advance()
        self._read()
        cost = float(self.touched)
        return self._observation(), 0.0, self.touched, False, {"cost": cost}

    @property
    def at_rest(self) -> bool:
        """Whether it stands."""
        return bool(abs(self.data.qvel[0]) < 1e-9)

    def reading(self, env: Any) -> tuple[float, float]:
        """Clearance and approach speed as the cart knows them: what a lease is granted from."""
        return self._reading

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

    def _observation(self) -> Array:
        return np.array(self._reading)
