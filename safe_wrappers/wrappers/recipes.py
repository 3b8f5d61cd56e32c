"""The constraints and plants that `protect` takes for each known env, and the reasons for their numbers."""

from collections.abc import Callable, Sequence
from typing import Any, Final

import gymnasium as gym
import mujoco
import numpy as np

from safe_wrappers.constraints import (
    Box,
    Clearance,
    CoastingClearance,
    Discs,
    EscapeClearance,
    HeadingDriveClearance,
    JointPositionLimit,
    JointSpeedLimit,
    Plane,
    PredictiveShield,
    SpeedLimit,
    TrackedDiscs,
    Traction,
    WallClearance,
    Workspace,
)
from safe_wrappers.constraints.joints import driven_joints
from safe_wrappers.control.shapes import merged
from safe_wrappers.envs import SPEED_LIMITS
from safe_wrappers.envs.goal_robots import CAR
from safe_wrappers.envs.teleop_contact import CLAMP_Y, TELEOP_BRAKING, TOOL_RADIUS
from safe_wrappers.errors import UnknownNameError
from safe_wrappers.filter.constraint import Constraint
from safe_wrappers.plants import MujocoPlant, Plant, SimulatorPlant
from safe_wrappers.plants.mujoco.model import HINGE
from safe_wrappers.plants.simulator import View

Env = gym.Env[Any, Any]
Recommended = list[Constraint]

POINT_PARTS_M = [[0.0, 0.1], [0.07, 0.0945]]
"""The Point robot's sphere, and its nose, whose far corners are 0.15 m ahead and 0.05 m aside: hypot(0.08, 0.05)."""
VASE_HULL_RADIUS_M = 0.1415
"""Around a vase's centre: the corners of a square of side 0.2, rounded up."""


def _point_goal(env: Env, detour: bool = True, uncertainty: float = 0.0) -> Recommended:
    vases = env.unwrapped.level.vases_cost  # type: ignore[attr-defined]
    return [
        HeadingDriveClearance(
            [Discs("hazard_positions", radius=0.2)],
            margin=0.004,
            uncertainty=uncertainty,
            detour=detour,
            untouched=[Discs("vase_positions", radius=VASE_HULL_RADIUS_M)] if vases else [],
            parts=POINT_PARTS_M if vases else [],
        )
    ]


def _car_goal(env: Env, detour: bool = True) -> Recommended:
    vases = env.unwrapped.level.vases_cost  # type: ignore[attr-defined]
    return [
        CoastingClearance(
            keep_out=[Discs("hazard_positions", radius=0.2)],
            untouched=[Discs("vase_positions", radius=VASE_HULL_RADIUS_M)] if vases else [],
            outline=[[side * x, y] for x, y in CAR.hull_corners for side in (1.0, -1.0)],
            robot_model_attr="robot_model",
            # Measured for full torque for one control step and then rest, 0.03 m from rest and 0.09 m from full
            # speed, and half as much again.
            max_decrease=0.05,
            max_decrease_per_speed=0.13,
            detour=detour,
        )
    ]


def _fixed(*constraints: Constraint) -> Callable[..., Recommended]:
    """The recipe of constraints that are the same for every env of an id; filters work with copies of them."""
    return lambda env: list(constraints)


_RAIL = Clearance(
    obstacles=[Plane([-0.95], [1.0]), Plane([0.95], [-1.0])],
    bodies=["cart"],
    # 300 N on 15.5 kg of cart and pole is 19 m/s^2, 500 N on 20 kg of cart and two poles 24 m/s^2; poles that tilt
    # and fall take up to two thirds of it.
    braking=8.0,
    # The pole pulls the cart while a control is held, by up to 2 mm (measured).
    margin=0.01,
)
# A plane, not a box: the tool cannot go round the clamp.
_CLAMP = Plane([0.0, CLAMP_Y], [0.0, -1.0])


def _of_what_is_known(env: Env, option: str, chosen: str, radius: float, true: str, sigmas: float) -> Any:
    """Discs at the true positions, at those seen last, or at the estimates of an OcclusionPenalty inside."""
    known: dict[str, Any] = {
        "true": TrackedDiscs(radius, sigmas, attribute=true),
        "last_seen": Discs("last_seen_positions", radius),
        "estimated": TrackedDiscs(radius, sigmas),
    }
    chosen = chosen or ("estimated" if env.has_wrapper_attr("tracking") else "true")
    if chosen not in known:
        raise UnknownNameError(f"{option} is one of {', '.join(known)}; got {chosen!r}")
    return known[chosen]


def _occluded_crossing(env: Env, cars: str = "", sigmas: float = 3.0) -> Recommended:
    raw: Any = env.unwrapped
    discs = _of_what_is_known(env, "cars", cars, raw.car_radius, "car_tracks", sigmas)
    # An escape must not lead through pillars, or over the rails at 4 m and 3.5 m.
    rails = [Plane([x, y], [-x, -y]) for x, y in ((-4.0, 0.0), (4.0, 0.0), (0.0, -3.5), (0.0, 3.5))]
    obstacles = [discs, Discs("pillar_positions", raw.pillar_radius), *rails]
    return [EscapeClearance("robot", obstacles, raw.robot_radius)]


def _patrolled_maze(env: Env, patrols: str = "", sigmas: float = 3.0) -> Recommended:
    raw: Any = env.unwrapped
    discs = _of_what_is_known(env, "patrols", patrols, raw.patrol_radius, "patrol_tracks", sigmas)
    # The escapes ignore walls: with walls as obstacles the only escape in a corridor is to stop, while evasion at the
    # last moment, within WallClearance, avoids more collisions. The ball comes to rest within 0.5 s.
    aside = EscapeClearance("particle", [discs], raw.ball_radius, margin=0.03, horizon_s=1.0)
    return [WallClearance(velocity_clip=5.0), aside]


def _ant_maze(env: Env) -> Recommended:
    # The torso's ball has 0.25 m; the legs reach farther and may touch.
    model: mujoco.MjModel = env.unwrapped.model  # type: ignore[attr-defined]
    fixed = (model.geom_bodyid == 0) & (model.geom_type == int(mujoco.mjtGeom.mjGEOM_BOX))
    boxes = zip(model.geom_pos[fixed], model.geom_size[fixed], strict=True)
    blocks = [(x - dx, x + dx, y - dy, y + dy) for (x, y, _), (dx, dy, _) in boxes]
    corners = merged(blocks)
    walls = [Box([(a + b) / 2.0, (c + d) / 2.0], [(b - a) / 2.0, (d - c) / 2.0]) for a, b, c, d in corners]
    # At 4 m/s an ant moves 1 m in five steps.
    return [Workspace(keep_out=walls, bodies=["torso"], radius=0.4, margin=0.01, horizon=5, max_decrease=1.0)]


FINGER_RADIUS_M = 0.0414
"""From the centre of a Fetch finger, a box of 77 x 14 x 27 mm, to its corners, rounded up."""


def _fetch(env: Env, keep_out: Sequence[Any] = ()) -> Recommended:
    raw: Any = env.unwrapped
    start = raw.initial_gripper_xpos
    geom = int(raw.model.body("table0").geomadr[0])
    middle = raw.model.geom_pos[geom] + raw.model.body("table0").pos
    half = raw.model.geom_size[geom]
    top = float(middle[2] + half[2])
    # Goals and objects lie within 0.15 m of the gripper's start (in FetchSlide farther away), objects are pushed from
    # 0.06 m beyond, and a block is lifted to 0.48 m above the table. The arm reaches all of the box to 15 mm.
    low = [float(start[0]) - 0.25, float(start[1]) - 0.25, top + 0.02]
    high = [float(start[0]) + 0.25, float(start[1]) + 0.25, top + 0.5]
    # A displacement of zero stops the gripper within one of the two control steps. In both it moves by 83 mm per axis
    # at most, and a finger that also opens or closes by 0.16 m in all (measured).
    grip = Workspace(low, high, sites=["robot0:grip"], margin=0.001, horizon=2, max_decrease=0.1)
    # An upright finger's tip stays 4 mm above the table, where it still meets the lower half of block and puck.
    obstacles = [Box(middle.tolist(), half.tolist()), *keep_out]
    fingers = [f"robot0:{side}_gripper_finger_link" for side in "lr"]
    clear = Workspace(
        keep_out=obstacles, geoms=fingers, radius=FINGER_RADIUS_M, margin=0.001, horizon=2, max_decrease=0.2
    )
    return [grip, clear]


SHADOW_HAND_TIED: Final = [f"robot0:{finger}J0" for finger in ("FF", "MF", "RF", "LF")]
"""Joints at the fingertips of gymnasium-robotics' hand, which a tendon moves together with the next ones."""


def _joint_speeds(
    hinges: float, margin: float, horizon: int, slides: float = 0.0, tied: Sequence[str] = ()
) -> Callable[..., Recommended]:
    """Speed limits of the driven joints, and of those that tendons move with them, rad/s and m/s."""

    def recipe(env: Env) -> Recommended:
        model: mujoco.MjModel = env.unwrapped.model  # type: ignore[attr-defined]
        driven = {model.joint(j).name: int(model.jnt_type[j]) == HINGE for j in driven_joints(model)}
        turning = [*(name for name, turns in driven.items() if turns), *tied]
        sliding = [name for name, turns in driven.items() if not turns]
        limits = [JointSpeedLimit(hinges, turning, margin=margin, horizon=horizon)]
        if sliding:
            limits.append(JointSpeedLimit(slides, sliding, margin=0.02, horizon=horizon))
        return list(limits)

    return recipe


LOOK_AHEAD_BELOW: Final = {"HalfCheetah": 0.8, "Hopper": 0.7, "Walker2d": 0.7, "Ant": 0.8, "Humanoid": 0.7}
"""Shares of the speed limit. Controls that left more after their own step were never refused by the look-ahead
under four kinds of drivers; Swimmer's were, whatever they left."""
EULER_LOOK_AHEAD: Final = ("Hopper", "Walker2d")
"""Robots on which a look-ahead by Euler steps leaves no more steps infeasible than one by its own."""


def _velocity(robot: str, margin: float = 0.02, horizon: int = 3) -> Callable[..., Recommended]:
    limit, share = SPEED_LIMITS[robot], LOOK_AHEAD_BELOW.get(robot)
    return _fixed(
        SpeedLimit(
            limit,
            body=None if robot == "Humanoid" else "torso",
            direction="xy" if robot in ("Ant", "Humanoid") else "+x",
            margin=margin,
            horizon=horizon,
            look_ahead_below=None if share is None else share * limit,
            euler_look_ahead=robot in EULER_LOOK_AHEAD,
        )
    )


RECIPES: dict[str, Callable[..., Recommended]] = {
    **{f"SafePointGoal{level}": _point_goal for level in range(3)},
    **{f"SafeCarGoal{level}": _car_goal for level in range(3)},
    "InvertedPendulum": _fixed(_RAIL),
    # The forecast is for swinging poles, which pull; alone it would brake late.
    "InvertedDoublePendulum": _fixed(
        _RAIL, JointPositionLimit(-0.95, 0.95, joints=["slider"], margin=0.005, horizon=5)
    ),
    # The effect of a torque on the ringing joint shows within one and a half periods of the lowest resonance.
    "FlexJointReach": _fixed(JointSpeedLimit(limit=8.0, margin=0.3, horizon=15)),
    # A torque of 200 N m on 1 kg m^2 for 0.02 s: one step can add 4 rad/s.
    "Reacher": _fixed(JointSpeedLimit(limit=5.0, margin=0.01, max_decrease=4.5)),
    "SafeRover": lambda env: [Traction(env.unwrapped.wheels)],
    "TeleopContact": _fixed(
        Clearance([_CLAMP], TELEOP_BRAKING, bodies=["tool"], radius=TOOL_RADIUS, margin=0.001)
    ),
    "OccludedCrossing": _occluded_crossing,
    # The tip stays over the table, clear of its top by 2.5 cm, and in front of the shoulder.
    "Pusher": _fixed(
        JointSpeedLimit(limit=6.0, margin=0.05),
        Workspace([-0.2, -1.2, -0.3], [0.9, 0.15, 0.4], bodies=["tips_arm"], margin=0.005, horizon=8),
    ),
    "HumanoidStandup": _fixed(JointSpeedLimit(limit=20.0, margin=0.1)),
    # gymnasium-robotics' point is clipped to 5 m/s along each axis before every step.
    "PointMaze": _fixed(WallClearance(velocity_clip=5.0)),
    "PatrolledPointMaze": _patrolled_maze,
    "AntMaze": _ant_maze,
    **{f"Fetch{task}": _fetch for task in ("Reach", "Push", "Slide", "PickAndPlace")},
    # Targets of position servos. With a horizon of three a wrist on slides had no way out in 2 of 400 steps.
    "HandReach": _joint_speeds(3.0, margin=0.05, horizon=1, tied=SHADOW_HAND_TIED),
    "AdroitHandPen": _joint_speeds(10.0, margin=0.1, horizon=2),
    "AdroitHandHammer": _joint_speeds(10.0, margin=0.2, horizon=2),
    "AdroitHandDoor": _joint_speeds(10.0, margin=0.1, horizon=4, slides=1.0),
    "AdroitHandRelocate": _joint_speeds(10.0, margin=0.1, horizon=4, slides=1.0),
    # With a horizon of three a trained policy found states with no way out (1 violation in 1000 steps); with a margin
    # of 0.005 as Swimmer's another one was 0.012 m/s too fast in 1 of 20,000.
    "HalfCheetah": _velocity("HalfCheetah", horizon=5),
    "Swimmer": _velocity("Swimmer", margin=0.005),
    **{robot: _velocity(robot) for robot in ("Hopper", "Walker2d", "Ant", "Humanoid")},
}
"""By the env's id without its version, or the part of it before "_" (PointMaze_UMaze)."""


def _cart_pole_h(x: Any) -> float:
    return float(min(1.0 - abs(x[2]) / 0.15, 1.0 - abs(x[0]) / 2.0))


def _balancing(x: Any) -> int:
    # The gains are those of the linear quadratic regulator for weights (1, 0.1, 10, 0.1) and 0.01.
    return int(0.12 * x[0] + 0.15 * x[1] + x[2] + 0.24 * x[3] > 0.0)


def _lunar_lander(env: Env) -> Recommended:
    from gymnasium.envs.box2d import lunar_lander

    def h(view: View) -> float:
        if view.env.game_over:
            return -1.0
        return float(min(0.6 - abs(view.observation[4]), 1.0 - abs(view.observation[0])))

    def backup(view: View) -> Any:
        return lunar_lander.heuristic(view.env, view.observation)  # type: ignore[no-untyped-call]

    return [PredictiveShield(h, horizon=150, backup=backup, sees="view", candidates=6)]


def _crouching(stiffness: float, damping: float, *target: float) -> Callable[[View], Any]:
    """Feedback of angles and speeds of hips and knees to a posture in which a walker stands."""

    def backup(view: View) -> Any:
        angles, speeds = view.observation[[4, 6, 9, 11]], view.observation[[5, 7, 10, 12]]
        return np.clip(stiffness * (np.array(target) - angles) - damping * speeds, -1.0, 1.0)

    return backup


def _upright_walker(view: View) -> float:
    return -1.0 if view.env.game_over else float(0.8 - abs(view.observation[0]))


def _panda_h(raw: Any) -> float:
    at, low, high = raw.robot.get_ee_position(), [-0.2, -0.2, 0.02], [0.2, 0.2, 0.3]
    return float(np.minimum(np.subtract(at, low), np.subtract(high, at)).min())


def _highway(env: Env) -> Recommended:
    # SLOWER, the last of its actions; or, with continuous ones, full braking straight on.
    backup = 4 if isinstance(env.action_space, gym.spaces.Discrete) else np.array([-1.0, 0.0])
    return [PredictiveShield("crashed", horizon=4, backup=[backup, "hold"], candidates=4)]


def _kitchen_h(raw: Any) -> float:
    return 1.0 - float(np.abs(raw.data.qvel[:7]).max())


_WALKER: Final = _fixed(
    PredictiveShield(
        _upright_walker,
        horizon=60,
        # The best of 150 at random.
        backup=[
            _crouching(4.68, 0.31, 0.76, 0.49, -0.82, 0.82),
            _crouching(5.80, 0.65, 0.66, 0.48, 0.30, 1.08),
            _crouching(5.34, 1.00, 0.42, 1.05, -0.35, 0.53),
        ],
        sees="view",
        candidates=6,
    )
)
SHELF: Final[dict[str, Callable[..., Recommended]]] = {
    # Its motor is weaker than gravity, but takes out energy: falling from the top it reaches 4.8 rad/s.
    "Pendulum": _fixed(
        PredictiveShield(
            lambda x: 6.0 - abs(x[2]), horizon=40, backup=lambda x: [np.clip(-4.0 * x[2], -2.0, 2.0)]
        )
    ),
    # An action changes the speed by its 0.0015-fold.
    "MountainCarContinuous": _fixed(
        PredictiveShield(
            lambda x: 0.045 - abs(x[1]), horizon=60, backup=lambda x: [np.clip(-x[1] / 0.0015, -1.0, 1.0)]
        )
    ),
    "CartPole": _fixed(PredictiveShield(_cart_pole_h, horizon=60, backup=_balancing)),
    **dict.fromkeys(("LunarLander", "LunarLanderContinuous"), _lunar_lander),
    **dict.fromkeys(("BipedalWalker", "BipedalWalkerHardcore"), _WALKER),
    "PandaReach": _fixed(PredictiveShield(_panda_h, horizon=4, backup="zero", sees="env", margin=0.002)),
    **dict.fromkeys(("highway", "highway-fast"), _highway),
    # Its targets are clipped ahead of noisy measurements: no MujocoPlant forecasts that, a copy with the noise does.
    "FrankaKitchen": _fixed(PredictiveShield(_kitchen_h, horizon=3, backup="zero", sees="env", margin=0.05)),
    # 10 N on 1.1 kg of cart and pole is 9 m/s^2; the swinging pole takes up to a third of it.
    "dm_control/cartpole": _fixed(
        Clearance([Plane([-1.0], [1.0]), Plane([1.0], [-1.0])], bodies=["cart"], braking=6.0, margin=0.01)
    ),
    # What dm_control reports is the velocity at the end of a step. Over a physics substep the centre of mass moves by
    # up to 0.18 m/s less (measured), since legs that turn at 50 rad/s bend its way.
    "dm_control/walker": _fixed(SpeedLimit(1.0, None, "+x", margin=0.3, horizon=10, average="substep")),
}
"""For other packages' envs, with backups that were measured; dm_control's by the domain, without the task."""


def _of_physics() -> Plant:
    """The model and the data of dm_control's physics, in an env of shimmy's."""
    return MujocoPlant(
        model=lambda raw: raw._env.physics.model.ptr, data=lambda raw: raw._env.physics.data.ptr
    )


PLANTS: Final[dict[str, Callable[[], Plant]]] = {
    "CartPole": lambda: SimulatorPlant(control_dt=0.02),
    **dict.fromkeys(
        ("LunarLander", "LunarLanderContinuous", "BipedalWalker", "BipedalWalkerHardcore"),
        lambda: SimulatorPlant("fork", control_dt=1.0 / 50.0),
    ),
    "PandaReach": lambda: SimulatorPlant("fork", control_dt=0.04),  # 20 substeps of 2 ms
    "FrankaKitchen": lambda: SimulatorPlant(control_dt=0.08),  # 40 substeps of 2 ms
    **dict.fromkeys(("dm_control/cartpole", "dm_control/walker"), _of_physics),
}
"""Where it is not the default one: Box2D's worlds and PyBullet's server cannot be copied."""
EVERY: Final = dict(sorted({**RECIPES, **SHELF}.items()))
"""All recipes."""


def family_of(env: Env) -> str:
    """The env's id without version and kind of reward; of dm_control's the domain; "" without an id."""
    return _family(env.spec.id) if env.spec is not None else ""


def _family(env_id: str) -> str:
    namespace, _, name = env_id.rpartition("/")
    if namespace == "dm_control":
        return f"{namespace}/{name.partition('-')[0]}"
    return name.rpartition("-v")[0].removesuffix("Dense").removesuffix("Sparse")


def recipe_of(env_id: str) -> str | None:
    """The name of the recipe that `protect` has for an id, or None."""
    family = _family(env_id)
    robot = family.removeprefix("Safe").removesuffix("Velocity") if family.endswith("Velocity") else family
    return next((name for name in (robot, robot.partition("_")[0]) if name in EVERY), None)
