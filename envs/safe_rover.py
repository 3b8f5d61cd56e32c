"""A rover on dry, wet and icy ground: too much throttle spins its wheels, and a spun wheel does not steer."""

import math
from collections.abc import Mapping
from typing import Any, Final

import mujoco
import numpy as np
from gymnasium.spaces import Box
from gymnasium.utils import EzPickle

from safe_wrappers.errors import Array, ConfigurationError, UnknownNameError
from safe_wrappers.info import COST, COST_SUBSTEP, SPIN_OUT

from .field import FieldEnv
from .goal_robots import LIDAR_BINS, pseudo_lidar
from .ground import GROUNDS, UPRIGHT, Ground, Patch, Tyres
from .layout import PLACE, POSE, Form, Given, layout_option, numbers, place_goal_beside, place_objects, places

WHEELS: Final = ("front_left", "front_right", "rear_left", "rear_right")
"""The wheels' joints, bodies and geoms, in the order of every array of four."""

SPIN_OUT_SLIP: Final = 0.5
"""Longitudinal slip from which on a wheel has spun out, or locked."""
ROVER_HAZARD_RADIUS: Final = 0.3
"""Radius of a hazard's disc, m: the chassis's centre must stay outside."""
WHEELBASE: Final = 0.5
"""Between the axles, m."""
HALF_EXTENT: Final = 4.0
"""The field is the square [-4, 4]^2, m: objects are sampled in it; the rover may leave it."""
HAZARDS: Final = 6
"""Hazards in a sampled layout, and the most in a given one."""
SAMPLED_GROUNDS: Final = ("wet", "wet", "wet", "wet", "ice", "ice", "ice", "ice")
"""Grounds of the patches in a sampled layout; as many are the most in a given one."""
KEEPOUTS: Final = {"agent": 0.7, "goal": 0.5, "hazards": 0.4}
"""m; patches have none."""

_PATCH_RADII: Final = (0.6, 1.0)  # m, uniform
_PATCH_KEYS: Final = ("ground", "center", "radius")
_FORMS: Final[dict[str, Form]] = {
    "agent": POSE,
    "goal": PLACE,
    "hazards": places(HAZARDS),
    "speed": ("a number of m/s", ()),
}
LAYOUT_KEYS: Final = ("agent", "goal", "hazards", "patches", "ground", "speed")
"""What the rover's ``reset(options={"layout": {...}})`` understands."""

_FRAME_SKIP: Final = 5
_LIDAR_RANGE: Final = 12.0  # m: across the field
_SETTLING: Final = 12  # rounds until loads and tyre forces agree: each leaves a quarter of the difference
_COLOURS: Final = {
    "dry": (0.55, 0.5, 0.45, 0.6),
    "wet": (0.25, 0.35, 0.45, 0.6),
    "snow": (1.0, 1.0, 1.0, 0.9),
    "ice": (0.65, 0.9, 1.0, 0.9),
}
_CAMERA: Final = {"distance": 11.0, "elevation": -55.0, "azimuth": 90.0, "lookat": np.array([0.0, -0.4, 0.0])}


class SafeRoverEnv(FieldEnv):
    """Drive a rover to goals, around hazards, over patches of wet and icy ground that it cannot see.

    18 kg, 0.5 m between the axles and 0.4 m between the wheels, centre of mass 0.12 m high. Four wheels of
    0.1 m, each with 0.05 kg m^2 about its axle and a motor of its own; the front ones are steered together. MuJoCo
    gives each wheel its load; the tyre's force comes from its slip along and across, over the traction curve of
    the ground under it (`envs.ground.MAGIC_FORMULA`), anew at every physics substep.

    **Action**: ``Box(-1, 1, (5,), float32)``, held for 0.01 s (five physics substeps): the torques on the wheels in
    the order of `WHEELS`, 15 N m at 1, and the steering angle, 0.5 rad at 1 (left), followed by a servo within about
    0.1 s. Full throttle spins every wheel, on dry ground too, where 4.4 N m is what a wheel at rest can hold.

    **Observation**, float64, shape (42,): forward and lateral velocity (m/s), yaw rate (rad/s), acceleration
    forward and to the left (m/s^2), circumferential speed of each wheel (4, m/s), steering angle (rad), then
    pseudo-lidars of 16 bins and a range of 12 m for the goal and for the hazards. Nothing in it tells the ground.

    **Reward**: distance to the goal gained in this step (m), plus 1 on coming within 0.4 m of it; then a new goal
    is sampled and the episode goes on.

    **Info**, at every step and at reset: ``cost`` and its equal ``cost_substep`` (1.0 if the chassis's centre was
    inside a hazard's disc at the end of any physics substep), ``slip`` (longitudinal, of each wheel at the step's
    end), ``slip_max`` (of a loaded wheel at the ends of substeps), ``spin_out``, ``yaw_rate_error`` (rad/s, at most,
    from what steering angle and speed ask for), ``goal_met``, ``goals_reached``. At reset they judge the start state.

    **Layout**: ``reset(options={"layout": {"agent": [x, y, heading], "goal": [x, y], "hazards": [[x, y], ...],
    "patches": [{"ground": "ice", "center": [x, y], "radius": r}, ...], "ground": "dry", "speed": v}})``; any subset
    of the keys. Agent, goal, 6 hazards, 4 wet and 4 icy patches are sampled where they are not given; ``ground``
    is what lies everywhere else (dry without a word), ``speed`` the forward speed to start with (0).

    **State**: the rover's pose and velocity as of a free joint, steering angles and wheel angles. `set_state` works
    as in every Gymnasium MuJoCo env. The loads that the next tyre forces count with are those of the substep before
    and lie in MuJoCo's ``userdata``, so ``mj_getState`` has the whole state.

    **End**: an episode terminates only when the rover has rolled over; `gymnasium.make` truncates after 1000 steps.

    Args:
        kwargs: Passed to `gymnasium.envs.mujoco.MujocoEnv` (``render_mode``, ``width``, ``camera_name``, ...).

    Example:
        >>> import gymnasium as gym, numpy as np, safe_wrappers
        >>> env = gym.make("SafeRover-v0")
        >>> _ = env.reset(seed=0, options={"layout": {"patches": [], "ground": "ice"}})
        >>> for _ in range(20):
        ...     info = env.step(np.array([1, 1, 1, 1, 0]))[4]
        >>> info["spin_out"]
        1.0
    """

    metadata: dict[str, Any] = {**FieldEnv.metadata, "render_fps": 100}  # noqa: RUF012 (Gymnasium's)

    hazard_radius: Final = ROVER_HAZARD_RADIUS
    goal_radius = 0.4
    wheels: Final = WHEELS
    ground: Ground
    """The grounds of this episode: the truth that no driver may see."""

    def __init__(self, **kwargs: Any) -> None:
        EzPickle.__init__(self, **kwargs)
        low = np.concatenate([np.full(10, -np.inf), np.zeros(2 * LIDAR_BINS)])
        high = np.concatenate([np.full(10, np.inf), np.ones(2 * LIDAR_BINS)])
        super().__init__("safe_rover.xml", _FRAME_SKIP, Box(low, high, dtype=np.float64), _CAMERA, **kwargs)
        model = self.model
        self.wheel_radius = float(model.geom(WHEELS[0]).size[0])
        self._tyres = Tyres(model, WHEELS)
        self.wheel_dofs: list[int] = [int(model.joint(wheel).dofadr[0]) for wheel in WHEELS]
        self._steer = [int(model.joint(f"steer_{side}").qposadr[0]) for side in ("left", "right")]
        self._floor = int(model.geom("floor").id)
        self._floor_colour = model.geom_rgba[self._floor].copy()
        self._patch_geoms = [g for g in range(model.ngeom) if model.geom(g).name.startswith("patch")]
        self._apply(np.zeros(3), np.zeros(2), np.zeros((0, 2)), (), "dry", 0.0)

    @property
    def agent_heading(self) -> float:
        """Heading in [-pi, pi], rad."""
        w, x, y, z = self.data.qpos[3:7].tolist()
        return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))

    @property
    def forward_speed(self) -> float:
        """Speed of the chassis's centre along the heading, m/s."""
        heading = self.agent_heading
        vx, vy = self.data.qvel[:2].tolist()
        return float(vx * math.cos(heading) + vy * math.sin(heading))

    @property
    def hazard_positions(self) -> Array:
        """Centres of the hazards, shape (n, 2), m."""
        return np.array(self._targets[1:])

    def ground_under(self, wheel: str) -> str:
        """Name of the ground under a wheel now; `ValueError` for no wheel."""
        return self.ground.at(*self.data.xpos[self._tyres.bodies[WHEELS.index(wheel)], :2].tolist())

    def _parse(self, options: Mapping[str, Any] | None) -> Given:
        given = layout_option(options, LAYOUT_KEYS)
        found: dict[str, Any] = {"speed": 0.0, "ground": _ground(given.get("ground", "dry"))}
        found |= {key: numbers(given[key], key, form) for key, form in _FORMS.items() if key in given}
        if "patches" in given:
            found["patches"] = _patches(given["patches"])
        return {**found, "speed": float(found["speed"])}

    def reset_model(self) -> Array:
        # Patches lie anywhere, under whatever stands there, the icy ones on top.
        rng, given = self.np_random, self._given
        placed = place_objects(rng, HALF_EXTENT, KEEPOUTS, {"hazards": HAZARDS}, given)
        patches = given["patches"] if "patches" in given else _sample_patches(rng)
        self._apply(**placed, patches=patches, ground=given["ground"], speed=given["speed"])
        return self.observe()

    def set_state(self, qpos: Array, qvel: Array) -> None:
        """Set positions and velocities (shapes (13,), (12,)), with the controls at 0, and judge the state.

        Loads and tyre forces depend on each other through the load transfer: both are those of an equilibrium.
        """
        model, data = self.model, self.data
        for left_over in (data.ctrl, data.xfrc_applied, data.qacc_warmstart, data.userdata):
            left_over[:] = 0.0
        super().set_state(qpos, qvel)  # type: ignore[no-untyped-call]
        for _ in range(_SETTLING):
            data.userdata[:] = data.sensordata[:4]
            self._tyres.apply(data, self.ground.curve_at)
            mujoco.mj_forwardSkip(model, data, mujoco.mjtStage.mjSTAGE_VEL, 0)
        data.userdata[:] = data.sensordata[:4]
        self._begin_judging()
        self._judge()

    def _next_goal(self) -> Array:
        standing = {"agent": self.agent_position[None], "hazards": self._targets[1:]}
        return place_goal_beside(self.np_random, HALF_EXTENT, KEEPOUTS, standing)

    def _is_finite(self, observation: Array) -> bool:
        return bool(np.isfinite(observation).all())

    def _is_over(self) -> bool:
        _, x, y, _ = self.data.qpos[3:7].tolist()
        return bool(1.0 - 2.0 * (x * x + y * y) < UPRIGHT)

    def observe(self) -> Array:
        data = self.data
        vx, vy, _, _, _, yaw_rate, ax, ay, _ = data.sensordata[4:13].tolist()
        heading = self.agent_heading
        cos, sin = math.cos(heading), math.sin(heading)
        relative = (self._targets - data.qpos[:2]) @ np.array([[cos, -sin], [sin, cos]])
        rims = (self.wheel_radius * data.qvel[self.wheel_dofs]).tolist()
        sensors = [vx, vy, yaw_rate, ax, ay, *rims, self._steering_angle()]
        return np.concatenate([sensors, pseudo_lidar(relative, self._groups, 2, max_dist=_LIDAR_RANGE)])

    def _get_reset_info(self) -> dict[str, Any]:
        cost = float(self._violated)
        return {
            COST: cost,
            COST_SUBSTEP: cost,
            "slip": np.array(self._tyres.slips),
            "slip_max": self._slip_max,
            SPIN_OUT: float(self._slip_max > SPIN_OUT_SLIP),
            "yaw_rate_error": self._yaw_rate_error,
            **super()._get_reset_info(),
        }

    def _step_mujoco_simulation(self, ctrl: Array, n_frames: int) -> None:
        """Step substep by substep: the state's kinematics, the tyres' forces on it, then dynamics and integration."""
        model, data = self.model, self.data
        loads = data.sensordata[:4]
        data.ctrl[:] = ctrl
        self._begin_judging()
        for k in range(n_frames):
            mujoco.mj_step1(model, data)
            self._tyres.apply(data, self.ground.curve_at)
            if k:  # the first substep's start was judged as the end of the control step before
                self._judge()
            mujoco.mj_step2(model, data)
            data.userdata[:] = loads
        # Sensors and loads of the state reached.
        mujoco.mj_step1(model, data)
        self._tyres.apply(data, self.ground.curve_at)
        self._judge()
        mujoco.mj_forwardSkip(model, data, mujoco.mjtStage.mjSTAGE_VEL, 0)
        data.userdata[:] = loads

    def _begin_judging(self) -> None:
        self._violated = False
        self._slip_max = self._yaw_rate_error = 0.0

    def _judge(self) -> None:
        """Judge the present state, whose slips were kept, on top of what was judged before."""
        x, y = self.data.qpos[:2].tolist()
        for hx, hy in self._hazards:
            if (x - hx) ** 2 + (y - hy) ** 2 <= ROVER_HAZARD_RADIUS**2:
                self._violated = True
        for slip, load in zip(self._tyres.slips, self.data.userdata.tolist(), strict=True):
            if load > 0.0:
                self._slip_max = max(self._slip_max, abs(slip))
        asked = self.forward_speed * math.tan(self._steering_angle()) / WHEELBASE
        self._yaw_rate_error = max(self._yaw_rate_error, abs(float(self.data.qvel[5]) - asked))

    def _steering_angle(self) -> float:
        left, right = self._steer
        qpos = self.data.qpos
        return 0.5 * float(qpos[left] + qpos[right])

    def _apply(
        self,
        agent: Array,
        goal: Array,
        hazards: Array,
        patches: tuple[Patch, ...],
        ground: str,
        speed: float,
    ) -> None:
        """Start an episode from a layout, the wheels rolling along."""
        self._groups = np.repeat([0, 1], [1, len(hazards)])
        self._hazards = hazards.tolist()
        self.ground = Ground(ground, patches)
        self._begin(goal, hazards)
        self._show_grounds()
        x, y, heading = agent.tolist()
        qpos, qvel = self.init_qpos.copy(), np.zeros(self.model.nv)
        qpos[:2] = x, y
        qpos[3:7] = math.cos(0.5 * heading), 0.0, 0.0, math.sin(0.5 * heading)
        qvel[:2] = speed * math.cos(heading), speed * math.sin(heading)
        qvel[self.wheel_dofs] = speed / self.wheel_radius
        self.set_state(qpos, qvel)

    def _show_grounds(self) -> None:
        """Move what is drawn of patches where they are; none of it touches anything."""
        mocap, model, ground = self.data.mocap_pos, self.model, self.ground
        first = len(mocap) - len(self._patch_geoms)
        for i, (patch, geom) in enumerate(zip(ground.patches, self._patch_geoms, strict=False)):
            mocap[first + i, :2] = patch.center
            model.geom_size[geom, 0] = model.geom_rbound[geom] = patch.radius
            model.geom_rgba[geom] = _COLOURS[patch.ground]
        colour = self._floor_colour if ground.base == "dry" else (*_COLOURS[ground.base][:3], 1.0)
        model.geom_rgba[self._floor] = colour


def _sample_patches(rng: np.random.Generator) -> tuple[Patch, ...]:
    patches = []
    for ground in SAMPLED_GROUNDS:
        radius = float(rng.uniform(*_PATCH_RADII))
        x, y = rng.uniform(radius - HALF_EXTENT, HALF_EXTENT - radius, size=2).tolist()
        patches.append(Patch(ground, (x, y), radius))
    return tuple(patches)


def _patches(value: Any) -> tuple[Patch, ...]:
    if isinstance(value, str | Mapping) or not hasattr(value, "__iter__"):
        raise ConfigurationError(
            'layout \'patches\' must be a list of {"ground": name, "center": [x, y], "radius": m}; '
            f"got {value!r}"
        )
    patches = [_patch(item, f"patches[{i}]") for i, item in enumerate(value)]
    if len(patches) > len(SAMPLED_GROUNDS):
        raise ConfigurationError(
            f"layout gives {len(patches)} patches, but there are at most {len(SAMPLED_GROUNDS)}"
        )
    return tuple(patches)


def _patch(value: Any, where: str) -> Patch:
    if not isinstance(value, Mapping) or set(value) != set(_PATCH_KEYS):
        raise UnknownNameError(
            f"layout {where!r} must be a mapping with the keys {', '.join(_PATCH_KEYS)}; got {value!r}"
        )
    x, y = numbers(value["center"], f"{where}['center']", PLACE).tolist()
    radius = float(numbers(value["radius"], f"{where}['radius']", ("a number of m", ())))
    if radius <= 0.0:
        raise ConfigurationError(f"layout {where!r} must have a radius > 0 m; got {value!r}")
    return Patch(_ground(value["ground"]), (x, y), radius)


def _ground(value: Any) -> str:
    if not (isinstance(value, str) and value in GROUNDS):
        raise UnknownNameError(f"unknown ground {value!r}: valid grounds are {', '.join(GROUNDS)}")
    return value
