"""Crossing a road whose cars hide behind pillars: what is not seen has to be estimated."""

import math
from collections.abc import Mapping
from typing import Any, Final

import mujoco
import numpy as np
from gymnasium.utils import EzPickle

from safe_wrappers.control.estimation import Motion, Tracks
from safe_wrappers.errors import Array, ConfigurationError
from safe_wrappers.info import COLLISIONS, COST, COST_SUBSTEP

from .field import FieldEnv
from .layout import PLACE, POSE, Form, Given, parse_layout
from .traffic import CAR_ACCELERATION_NOISE, CAR_MEAN_SPEED, CAR_SPEED_STD, CAR_TIME_CONSTANT_S, Traffic

FIELD: Final = (4.0, 3.5)
"""The field is ``|x| <= 4``, ``|y| <= 3.5``, m: rails keep the robot in it."""
LANE_CENTRES: Final = (-0.8, 0.8)
"""Their y, m: the first lane leads towards +x, the second towards -x."""
CARS_PER_LANE: Final = 3
CARS: Final = 2 * CARS_PER_LANE
PILLARS: Final = 4
"""Two on the lower pavement, then two on the upper one."""
ROBOT_RADIUS: Final = 0.2
PILLAR_RADIUS: Final = 0.35

_PAVEMENT: Final = 2.9  # m: |y| of starts and goals
_AGENT_REACH: Final = 2.0  # m: |x|
_GOAL_REACH: Final = 2.5
_PILLAR_REACH: Final = 3.0
_PILLAR_BAND: Final = (1.8, 2.0)  # m: |y|
_PILLAR_SPACING: Final = 1.5  # m between the centres of two on one side: the robot fits through
_CAR_START: Final = (-7.0, -2.0)  # m: the first of a lane, seen along it
_CAR_GAPS: Final = (5.0, 8.0)  # m between the centres of one and the next
_SPARE: Final = 0.05  # m between the robot and a pillar, at least
_TRIES: Final = 1000

CAR_BODIES: Final = tuple(f"car{i}" for i in range(CARS))
"""The cars' bodies and joints, in the order of every array of six: the first three drive towards +x."""
CAR_RADIUS: Final = 0.4
"""m."""

_FRAME_SKIP: Final = 4
_CARS: Final = slice(3, 3 + CARS)  # coordinates: robot x, y, heading, then the cars' x
_CONTACT_SQUARED: Final = (CAR_RADIUS + ROBOT_RADIUS) ** 2
_CAMERA: Final = {"distance": 10.0, "elevation": -60.0, "azimuth": 90.0, "lookat": np.array([0.0, -0.4, 0.0])}
_FORMS: Final[dict[str, Form]] = {
    "agent": POSE,
    "goal": PLACE,
    "cars": (f"[[x, v], ...] of {CARS} cars", (CARS, 2)),
    "pillars": (f"[[x, y], ...] of {PILLARS} pillars", (PILLARS, 2)),
}


class OccludedCrossingEnv(FieldEnv):
    """Cross a road of two lanes, again and again, between cars that pillars hide and the observation leaves out.

    A disc of 0.2 m and 1 kg with a camera and a site, both called ``eye``, 0.15 m ahead of the axis that it turns
    about and 0.3 m high, looking ahead (the camera along its -z, the site's z axis points there; 100 degrees). Two
    pillars on each pavement stop the robot and hide what is behind them. Cars are discs of 0.4 m in lanes at
    y = -0.8 m (towards +x) and y = +0.8 m (towards -x); they drive as `traffic.Traffic` says, react to nothing, and
    pass through the robot and each other: whether they would have hit it is judged.

    **Action**: ``Box(-1, 1, (3,), float32)``, held for 0.04 s (four physics substeps): the force along the world's x
    and y, 4 N at 1, and the torque that turns the robot. Damped by 2 N s/m, it reaches 2 m/s along each axis (2.8 m/s
    along both), and brakes with 4 m/s^2 or more at any speed. It turns with 4 rad/s at most; 0.15 s take
    it to 96 % of that.

    **Observation**, float64, shape (17,): position (2, m), velocity (2, m/s), cosine and sine of the heading, yaw
    rate (rad/s), goal and pillars relative to the robot (2 and 4 times 2, m), all along the world's axes. No cars:
    what can be seen of them is for a sensor to add.

    **Reward**: distance to the goal gained in this step (m), plus 1 on coming within 0.3 m of it; then a new goal is
    sampled on the other side of the road and the episode goes on.

    **Info**, at every step and at reset: ``cost`` and its equal ``cost_substep`` (1.0 if robot and car overlapped at
    the end of any physics substep), ``collisions``, ``goal_met``, ``goals_reached``. At reset they judge the start
    state, where every overlap counts as begun.

    **Layout**: ``reset(options={"layout": {"agent": [x, y, heading], "goal": [x, y], "cars": [[x, v], ...],
    "pillars": [[x, y], ...]}})``, six cars (v along x) and four pillars; any subset of the keys, the rest is sampled.

    **Randomness**: the seed alone decides the cars' way through a whole episode, whatever the robot does.

    **State**: `set_state` takes the robot's x, y and heading and the cars' x (9 coordinates, m and rad), and their
    rates.

    **End**: an episode never terminates; `gymnasium.make` truncates after 500 steps (20 s).

    Args:
        kwargs: Passed to `gymnasium.envs.mujoco.MujocoEnv` (``render_mode``, ``width``, ``camera_name``, ...).

    Example:
        >>> import gymnasium as gym, numpy as np, safe_wrappers
        >>> env = gym.make("OccludedCrossing-v0")
        >>> _ = env.reset(seed=0)
        >>> for _ in range(100):
        ...     observation, reward, _, _, info = env.step(np.array([0, 1, 0]))
        >>> bool(observation[1] > 1.3)  # straight ahead, over the road
        True
    """

    metadata: dict[str, Any] = {**FieldEnv.metadata, "render_fps": 25}  # noqa: RUF012 (Gymnasium's)

    robot_radius: Final = ROBOT_RADIUS
    car_radius: Final = CAR_RADIUS
    pillar_radius: Final = PILLAR_RADIUS
    goal_radius = 0.3
    car_bodies: Final = CAR_BODIES
    lane_centres: Final = LANE_CENTRES

    def __init__(self, **kwargs: Any) -> None:
        EzPickle.__init__(self, **kwargs)
        super().__init__("occluded_crossing.xml", _FRAME_SKIP, 9 + 2 * PILLARS, _CAMERA, **kwargs)
        self._lanes = np.repeat(LANE_CENTRES, CARS_PER_LANE)
        self._mean_velocities = CAR_MEAN_SPEED * np.repeat([1.0, -1.0], CARS_PER_LANE)
        self._traffic = Traffic(self._mean_velocities, self.model.opt.timestep, _FRAME_SKIP)
        self._cars_random = np.random.default_rng(0)  # until the first reset
        along = np.diag([CAR_ACCELERATION_NOISE, 0.0])
        ways = [Motion(along, CAR_TIME_CONSTANT_S, np.array([v * CAR_MEAN_SPEED, 0.0])) for v in (1.0, -1.0)]
        self._tracks = Tracks([motion for motion in ways for _ in range(CARS_PER_LANE)])
        cars = np.stack([np.zeros(CARS), self._mean_velocities], axis=1)
        self._apply(np.array([0.0, -2.9, 0.0]), np.zeros(2), cars, np.zeros((PILLARS, 2)))

    @property
    def agent_velocity(self) -> Array:
        """Shape (2,), m/s."""
        return np.array(self.data.qvel[:2])

    @property
    def agent_heading(self) -> float:
        """Heading in [-pi, pi], rad."""
        return math.remainder(self.data.qpos[2], math.tau)

    @property
    def pillar_positions(self) -> Array:
        """Centres of the pillars, shape (4, 2), m."""
        return np.array(self._targets[1:])

    @property
    def car_positions(self) -> Array:
        """Centres of the cars, shape (6, 2), m: the truth that no driver may see."""
        return np.stack([self.data.qpos[_CARS], self._lanes], axis=1)

    @property
    def car_velocities(self) -> Array:
        """Velocities of the cars, shape (6, 2), m/s: as true."""
        return np.stack([self.data.qvel[_CARS], np.zeros(CARS)], axis=1)

    @property
    def car_tracks(self) -> Tracks:
        """The cars' true states, without uncertainty now, and how they move: what a perfect tracker would know."""
        states = np.concatenate([self.car_positions, self.car_velocities], axis=1)
        self._tracks.start(states, np.zeros((CARS, 4, 4)))
        return self._tracks

    def _parse(self, options: Mapping[str, Any] | None) -> Given:
        parsed = parse_layout(options, _FORMS)
        if "agent" in parsed:
            _check_agent(parsed["agent"][:2], parsed.get("pillars", np.zeros((0, 2))))
        return parsed

    def reset_model(self) -> Array:
        layout = _sample_layout(self.np_random, self._given)
        # A stream of the cars' own: a goal reached, and so the next one drawn, must not change their way.
        self._cars_random = np.random.default_rng(self.np_random.integers(2**63))
        self._apply(**layout)
        return self.observe()

    def set_state(self, qpos: Array, qvel: Array) -> None:
        """Set positions and velocities, shape (9,) each, with the controls at 0, and judge the state."""
        for left_over in (self.data.ctrl, self.data.qacc_warmstart):
            left_over[:] = 0.0
        super().set_state(qpos, qvel)  # type: ignore[no-untyped-call]
        self._touching = np.zeros(CARS, dtype=bool)
        self._judge(self.data.qpos[None, :2], self.data.qpos[None, _CARS])

    def _next_goal(self) -> Array:
        return _sample_goal(self.np_random, self.agent_position, self._targets[1:])

    def _is_finite(self, observation: Array) -> bool:
        return math.isfinite(float(self.data.qpos.sum() + self.data.qvel.sum()))

    def observe(self) -> Array:
        x, y, heading = self.data.qpos[:3].tolist()
        vx, vy, yaw_rate = self.data.qvel[:3].tolist()
        goal_x, goal_y = self._targets[0].tolist()
        observation = np.empty(9 + 2 * PILLARS)
        observation[:9] = x, y, vx, vy, math.cos(heading), math.sin(heading), yaw_rate, goal_x - x, goal_y - y
        observation[9:] = (self._targets[1:] - self.data.qpos[:2]).ravel()
        return observation

    def _get_reset_info(self) -> dict[str, Any]:
        return {
            COST: self._cost,
            COST_SUBSTEP: self._cost,
            COLLISIONS: self._collisions,
            **super()._get_reset_info(),
        }

    def _step_mujoco_simulation(self, ctrl: Array, n_frames: int) -> None:
        """Step substep by substep: MuJoCo moves the robot, the traffic's law the cars. Judge them all at the end."""
        model, data = self.model, self.data
        qpos, qvel = data.qpos, data.qvel
        step_s = model.opt.timestep
        if (self._traffic.step_s, self._traffic.steps) != (step_s, n_frames):
            self._traffic = Traffic(self._mean_velocities, step_s, n_frames)
        cars = self._traffic.drive(self._cars_random, qpos[_CARS], qvel[_CARS])
        robot = np.empty((n_frames, 2))
        data.ctrl[:] = ctrl
        for k in range(n_frames):
            mujoco.mj_step(model, data)
            qpos[_CARS], qvel[_CARS] = cars[k]
            robot[k] = qpos[:2]
        mujoco.mj_forward(model, data)  # poses, sensors and contacts of the state reached
        self._judge(robot, cars[:, 0])

    def _judge(self, robot: Array, cars: Array) -> None:
        """Judge consecutive substeps: the robot's positions, shape (n, 2), and the cars' x, shape (n, 6)."""
        ahead = cars - robot[:, :1]
        aside = self._lanes - robot[:, 1:]
        touching = ahead * ahead + aside * aside <= _CONTACT_SQUARED
        self._cost, self._collisions = 0.0, 0
        if touching.any():
            before = np.concatenate([self._touching[None], touching[:-1]])
            self._cost, self._collisions = 1.0, int((touching & ~before).sum())
        self._touching = touching[-1]

    def _apply(self, agent: Array, goal: Array, cars: Array, pillars: Array) -> None:
        """Start an episode from a layout, the robot at rest."""
        self._begin(goal, pillars)
        qpos, qvel = np.zeros(self.model.nq), np.zeros(self.model.nv)
        qpos[:3] = agent
        qpos[_CARS], qvel[_CARS] = cars.T
        self.set_state(qpos, qvel)


def _check_agent(place: Array, pillars: Array) -> None:
    room = np.array(FIELD) - ROBOT_RADIUS
    if (np.abs(place) > room).any():
        raise ConfigurationError(
            f"layout 'agent' must stand inside the rails, |x| <= {room[0]:g} and |y| <= {room[1]:g};"
            f" got {place.tolist()}"
        )
    if _slack(place, pillars) < 0.0:
        raise ConfigurationError(
            f"layout 'agent' stands in a pillar: its centre must be {ROBOT_RADIUS + PILLAR_RADIUS:g} m or more"
            f" from each pillar's; got {place.tolist()} and pillars {pillars.tolist()}"
        )


def _sample_layout(rng: np.random.Generator, given: Given) -> dict[str, Array]:
    """Sample what is missing of a layout; given parts are kept as they are.

    The robot starts on the lower pavement and faces the road; the goal lies on the other side. In each lane the first
    car is 2 to 7 m before the field's middle and each next one 5 to 8 m behind; speeds are drawn from their
    stationary distribution.
    """
    parts = dict(given)
    if "agent" not in parts:
        place = _sample_clear(rng, _AGENT_REACH, -_PAVEMENT, given.get("pillars", np.zeros((0, 2))))
        parts["agent"] = np.append(place, 0.5 * np.pi)
    if "pillars" not in parts:
        parts["pillars"] = _sample_pillars(rng, parts["agent"], given.get("goal"))
    if "goal" not in parts:
        parts["goal"] = _sample_goal(rng, parts["agent"][:2], parts["pillars"])
    if "cars" not in parts:
        parts["cars"] = _sample_cars(rng)
    return parts


def _sample_goal(rng: np.random.Generator, agent: Array, pillars: Array) -> Array:
    """Sample a goal, shape (2,), m, on the pavement across the road, where the robot fits between the pillars.

    Four pillars leave at least 0.2 of the 5 m free, so there is a place wherever they stand.
    """
    side = _PAVEMENT if agent[1] <= 0.0 else -_PAVEMENT
    return _sample_clear(rng, _GOAL_REACH, side, pillars)


def _sample_clear(rng: np.random.Generator, reach: float, y: float, pillars: Array) -> Array:
    for _ in range(_TRIES):
        point = np.array([rng.uniform(-reach, reach), y])
        if _slack(point, pillars) >= _SPARE:
            return point
    raise ConfigurationError(
        f"no room for the robot at y = {y:g}, |x| <= {reach:g}: layout 'pillars' {pillars.tolist()} cover it;"
        " give other pillars, or 'agent' too"
    )


def _sample_pillars(rng: np.random.Generator, agent: Array, goal: Array | None) -> Array:
    """Pillars beside the robot, and beside the goal if that stands already."""
    taken = agent[None, :2] if goal is None else np.stack([agent[:2], goal])
    while True:  # robot and goal stand in the way of at most 2.4 m of the 12
        x = rng.uniform(-_PILLAR_REACH, _PILLAR_REACH, PILLARS)
        y = rng.uniform(*_PILLAR_BAND, PILLARS) * (-1.0, -1.0, 1.0, 1.0)
        pillars = np.stack([x, y], axis=1)
        apart = min(abs(x[0] - x[1]), abs(x[2] - x[3]))
        if apart >= _PILLAR_SPACING and min(_slack(point, pillars) for point in taken) >= _SPARE:
            return pillars


def _sample_cars(rng: np.random.Generator) -> Array:
    first = rng.uniform(*_CAR_START, (2, 1))
    gaps = rng.uniform(*_CAR_GAPS, (2, CARS_PER_LANE - 1))
    along = np.concatenate([first, first - np.cumsum(gaps, axis=1)], axis=1)
    speeds = rng.normal(CAR_MEAN_SPEED, CAR_SPEED_STD, (2, CARS_PER_LANE))
    directions = np.array([[1.0], [-1.0]])
    return np.stack([(directions * along).ravel(), (directions * speeds).ravel()], axis=1)


def _slack(point: Array, pillars: Array) -> float:
    """Room between the robot at a point and the nearest pillar, m; negative inside."""
    return float(np.hypot(*(pillars - point).T).min(initial=np.inf)) - ROBOT_RADIUS - PILLAR_RADIUS
