"""The filter, the judge and the drivers of each row in docs/results/standard-envs.md."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

import safe_wrappers as sw
from benchmarks import fetch, judges
from benchmarks import mujoco_drivers as drivers
from benchmarks.car_drivers import DRIVERS as CAR_GOAL
from benchmarks.drivers import CROSSING, PATROLLED, Maker
from benchmarks.drivers import DRIVERS as POINT_GOAL
from benchmarks.judges import Judge, Replay, Reported
from safe_wrappers.envs import SPEED_LIMITS
from safe_wrappers.envs.teleop_contact import CLAMP_Y, TOOL_RADIUS
from safe_wrappers.wrappers.recipes import SHADOW_HAND_TIED


@dataclass(frozen=True)
class Case:
    """One env under one filter.

    Attributes:
        env_id: Of the env.
        judge: Makes the judge of an unwrapped env.
        drivers: By name.
        protect: Puts the filter on.
        also: Ids of envs with the same physics and the same constraints.
        note: What is different from the plain env, in words.
        past_termination: An episode goes on when the env says that it is over, to its time limit.
        max_episode_steps: Time limit; None is the env's own.
    """

    env_id: str
    judge: Callable[[Any], Judge]
    drivers: dict[str, Maker]
    protect: Callable[[gym.Env[Any, Any]], sw.CBFActionFilter] = sw.protect
    also: tuple[str, ...] = ()
    note: str = ""
    past_termination: bool = False
    max_episode_steps: int | None = None

    @property
    def name(self) -> str:
        """Of its row."""
        return f"{self.env_id}, {self.note}" if self.note else self.env_id

    def make(self, render_mode: str | None = None) -> gym.Env[Any, Any]:
        """The env without the filter."""
        if any(word in self.env_id for word in ("Maze", "Fetch", "Hand")):
            import gymnasium_robotics

            gym.register_envs(gymnasium_robotics)
        return gym.make(self.env_id, max_episode_steps=self.max_episode_steps, render_mode=render_mode)


def driven(
    case: Case, env: gym.Env[Any, Any], driver: str, steps: int, seed: int, episode: int
) -> Iterator[tuple[Any, float, dict[str, Any], bool, bool]]:
    """Drives a case's env, filtered or not, and judges: action, reward, info, violation and end of each step.

    Resets have the seeds from `episode` on; one that is in violation itself is left out.
    """
    judge, over = case.judge(env.unwrapped), True
    act = case.drivers[driver](env.unwrapped, np.random.default_rng(seed))
    for _ in range(steps):
        while over:
            env.reset(seed=episode)
            over, episode = not judge.start() <= 0.0, episode + 1
        action = np.asarray(act(), dtype=env.action_space.dtype)
        judge.before()
        _, reward, terminated, truncated, info = env.step(action)
        missed = judge.after(info.get("executed_action", action), info)
        over = bool(truncated or (terminated and not case.past_termination))
        yield action, float(reward), info, not missed <= 0.0, over  # what is not a number is a violation


def crossing(env: gym.Env[Any, Any], tolerance: float = 0.5, weight: float = 0.0) -> sw.OcclusionPenalty:
    """OccludedCrossing with its cars tracked, as configs/occluded_crossing_ppo.yaml has it."""
    car = {
        # 2 * 0.15^2 / 2 = 0.0225 m^2/s^3 along their lanes, and nothing across: safe_wrappers.envs.traffic.
        "acceleration_noise": [0.0225, 0],
        "reversion_s": 2.0,
        "start_position_std": [0.3, 0],
        "start_velocity_std": [0.15, 0],
    }
    lanes = (("car[012]", 1), ("car[345]", -1))
    tracks = [{"bodies": bodies, "mean_velocity": [mean, 0], **car} for bodies, mean in lanes]
    sensor = {"camera": "eye", "view_deg": 120, "range_m": 6, "position_std": 0.05}
    return sw.OcclusionPenalty(env, tracks, sensor, tolerance, weight)


def patrolled(env: gym.Env[Any, Any]) -> sw.OcclusionPenalty:
    """PatrolledPointMaze on the U maze with its patrols tracked."""
    patrol = {
        "published": "patrol_positions",
        # 2 * (0.5^2 + 0.15^2) / 2 = 0.2725 m^2/s^3 along the corridor: safe_wrappers.envs.patrolled_maze.
        "acceleration_noise": [0.2725, 0],
        "reversion_s": 2.0,
        "start_position_std": [0.1, 0],
        "start_velocity_std": [0.55, 0],
    }
    return sw.OcclusionPenalty(env, [patrol], {"site": "particle_site", "position_std": 0.02}, tolerance=0.5)


_BLIND: dict[str, Maker] = {
    "random": drivers.random,
    "bang-bang": drivers.bang_bang,
    "pulse": drivers.pulse,
}
_RAIL = _BLIND | {"end-seeking": drivers.end_seeking, "carrying": drivers.carrying}
_SPEED = _BLIND | {"speed-seeking": drivers.speed_seeking}

_DISC, _DISC_RADIUS = (-0.1, 0.1), 0.05


def _replayed(*truths: Callable[[mujoco.MjModel], judges.Truth]) -> Callable[[Any], Judge]:
    return lambda env: Replay(env, judges.any_of(*(truth(env.model) for truth in truths)))


def _joint_speeds(limit: float) -> Callable[[mujoco.MjModel], judges.Truth]:
    return lambda model: judges.joints_too_fast(model, limit)


_RAIL_ENDS = _replayed(lambda model: judges.joint_beyond(model, "slider", 0.95))


def _reacher_and_disc(env: gym.Env[Any, Any]) -> sw.CBFActionFilter:
    speeds = sw.constraints.JointSpeedLimit(5.0, margin=0.01, max_decrease=4.5)
    disc = sw.constraints.Workspace(
        keep_out=[sw.constraints.Disc(list(_DISC), _DISC_RADIUS)],
        bodies=["fingertip"],
        margin=0.001,
        horizon=3,
    )
    return sw.CBFActionFilter(env, [speeds, disc])


# Beyond every side of the tip's box: past the table's edges, through its top, behind the shoulder, up.
_OFF_THE_TABLE = drivers.point_seeking(
    "tips_arm",
    [
        (0.4, -0.3, -0.6),
        (0.4, 0.5, -0.2),
        (1.3, -0.3, 0.0),
        (-0.6, -0.3, 0.0),
        (0.3, -0.4, 0.9),
        (0.3, -1.6, 0.0),
    ],
)


def _velocity(robot: str, limit: float, plane: bool) -> Case:
    sprint = drivers.sprinting if plane else drivers.sprinting_along_x
    return Case(
        f"Safe{robot}Velocity-v0",
        judge=lambda env: Reported(judges.faster_than(limit, plane)),
        drivers={"random": drivers.random, "pulse": drivers.pulse, "sprinting": sprint},
        also=(f"{robot}-v5",),
    )


def _goal_task(robot: str, level: int, known: dict[str, Maker]) -> Case:
    # Level 0 has nothing to seek or to drift into.
    blind = {name: known[name] for name in ("random", "goal-seeking", "bang-bang", "pulse") if name in known}
    return Case(
        f"Safe{robot}Goal{level}-v0",
        judge=lambda env: Reported(judges.costs),
        drivers=dict(known) if level else blind,
    )


def _touches_no_wall(env: Any, **more: Any) -> Judge:
    truth = judges.touches_wall(env.model, "particle_geom")
    return Replay(env, truth, prepare=judges.clip_speed(5.0), **more)


def _point_maze(maze: str) -> Case:
    return Case(f"PointMaze_{maze}-v3", _touches_no_wall, _BLIND | {"wall-seeking": drivers.wall_seeking})


def _fallen(env_id: str) -> Case:
    """A pendulum whose episodes go on after the fall: the cart goes far before the pole does only by chance."""
    return Case(
        env_id, _RAIL_ENDS, _RAIL, note="on after the fall", past_termination=True, max_episode_steps=500
    )


def _hand(env_id: str, limit: float, slides: float = np.inf, also: tuple[str, ...] = ()) -> Case:
    def judge(env: Any) -> Judge:
        truth = judges.joints_too_fast(env.model, limit, slides, also)
        return Replay(env, truth, control=judges.onto_ranges(env.model))

    return Case(env_id, judge, _SPEED if env_id.startswith("Adroit") else _BLIND)


def _by_name(*cases: Case) -> dict[str, Case]:
    return {case.name: case for case in cases}


PROTECTED: dict[str, Case] = _by_name(
    *(_goal_task("Point", level, POINT_GOAL) for level in range(3)),
    *(_goal_task("Car", level, CAR_GOAL) for level in range(3)),
    _fallen("InvertedPendulum-v5"),
    _fallen("InvertedDoublePendulum-v5"),
    Case("Reacher-v5", _replayed(_joint_speeds(5.0)), _SPEED),
    Case("FlexJointReach-v0", _replayed(_joint_speeds(8.0)), _SPEED),
    Case(
        "Pusher-v5",
        _replayed(
            _joint_speeds(6.0),
            lambda model: judges.outside_box(model, "tips_arm", (-0.2, -1.2, -0.3), (0.9, 0.15, 0.4)),
        ),
        _SPEED | {"off the table": _OFF_THE_TABLE},
    ),
    *(_velocity(robot, limit, robot in ("Ant", "Humanoid")) for robot, limit in SPEED_LIMITS.items()),
    Case("HumanoidStandup-v5", _replayed(_joint_speeds(20.0)), _SPEED),
    # At the edge of another ground a step or two overshoot the limit of 0.15; beyond 0.2 all grounds have fallen.
    Case(
        "SafeRover-v0",
        judge=lambda env: Reported(lambda info: float(info["slip_max"]) - 0.2),
        drivers=_BLIND | {"full throttle and reverse": drivers.end_seeking},
    ),
    # A step is 1 ms: half a minute of the others' pulses is half a second here.
    Case(
        "TeleopContact-v0",
        judge=_replayed(lambda model: judges.joint_above(model, "y", CLAMP_Y - TOOL_RADIUS)),
        drivers=_BLIND
        | {"pulse of 0.3 s": drivers.corners(hold=300), "clamp-seeking": drivers.clamp_seeking},
    ),
    Case(
        "OccludedCrossing-v0",
        judge=lambda env: Reported(judges.costs),
        drivers=_BLIND | CROSSING,
        protect=lambda env: sw.protect(crossing(env)),
    ),
    _point_maze("UMaze"),
    Case(
        "PatrolledPointMaze-v0",
        judge=lambda env: _touches_no_wall(env, reported=judges.costs),
        drivers=_BLIND | PATROLLED,
        protect=lambda env: sw.protect(patrolled(env)),
    ),
    Case(
        "AntMaze_UMaze-v5",
        judge=_replayed(lambda model: judges.near_wall(model, "torso", 0.4)),
        drivers={
            "random": drivers.random,
            "pulse": drivers.pulse,
            "wall-seeking": drivers.running_into_walls,
        },
    ),
    *(
        Case(f"Fetch{task}-v4", fetch.FetchJudge, fetch.DRIVERS)
        for task in ("Reach", "Push", "Slide", "PickAndPlace")
    ),
    _hand("HandReach-v3", 3.0, also=tuple(SHADOW_HAND_TIED)),
    *(_hand(f"AdroitHand{task}-v1", 10.0) for task in ("Pen", "Hammer")),
    *(_hand(f"AdroitHand{task}-v1", 10.0, slides=1.0) for task in ("Door", "Relocate")),
)
"""Every env that `protect` knows, by the name of its row."""

CASES: dict[str, Case] = PROTECTED | _by_name(
    Case("InvertedPendulum-v5", _RAIL_ENDS, _RAIL),
    Case("InvertedDoublePendulum-v5", _RAIL_ENDS, _RAIL),
    Case(
        "Reacher-v5",
        _replayed(
            _joint_speeds(5.0),
            lambda model: judges.inside_disc(model, "fingertip", _DISC, _DISC_RADIUS),
        ),
        _SPEED | {"disc-seeking": drivers.point_seeking("fingertip", [(*_DISC, 0.01)])},
        _reacher_and_disc,
        note="with a disc",
    ),
    _point_maze("Large"),
)
"""Likewise, with those that tests and other benchmarks attack besides."""
