"""The crossing under drivers that try to be hit: with the true cars and with estimates nothing unflagged hits it."""

import gymnasium as gym
import numpy as np
import pytest
from crossing_drivers import CARS, DRIVERS, CarSeeking, GoalSeeking, OnTheRoad, crossing, drive

import safe_wrappers as sw

pytestmark = pytest.mark.filterwarnings("ignore::safe_wrappers.UnsafeStateWarning")


def kept_or_flagged(env, action, info):
    """The control that was executed is admitted by what was known when it was chosen, or the step says so."""
    inner = env
    while not isinstance(inner, sw.CBFActionFilter):
        inner = inner.env
    executed = info["executed_action"]
    if not (info["cbf/infeasible"] or info["cbf/fallback"]):
        assert inner.filter.bound[0].admits(executed)
    if not info["cbf/intervened"]:
        assert executed.tobytes() == action.astype(np.float64).tobytes()


@pytest.mark.parametrize("driver", DRIVERS)
@pytest.mark.parametrize("cars", ["true", "estimated"])
def test_nothing_hits_it(cars, driver):
    told = drive(crossing(cars), driver, episodes=1, steps=250, watch=kept_or_flagged)
    assert told["collisions"] == 0 and told["flagged"] <= 5, told


def test_without_a_filter_they_are_hit():
    hits = [drive(crossing(None), d, episodes=1)["collisions"] for d in (GoalSeeking, CarSeeking, OnTheRoad)]
    assert min(hits) >= 1 and sum(hits) >= 8, hits


@pytest.mark.slow
def test_under_a_delay_it_holds_as_well():
    raw = gym.make("OccludedCrossing-v0")
    env = sw.OcclusionPenalty(raw, CARS, sw.occlusion.Sensor("eye", view_deg=120, range_m=6.0), 0.5)
    pillars = sw.constraints.Discs("pillar_positions", 0.35)  # not to be pressed against one, with no way out
    rails = [sw.constraints.Plane([x, y], [-x, -y]) for x, y in ((-4, 0), (4, 0), (0, -3.5), (0, 3.5))]
    ways = sw.constraints.EscapeClearance("robot", [sw.constraints.TrackedDiscs(0.4), pillars, *rails], 0.2)

    class Late(gym.Wrapper):
        """Executes what was sent two steps before."""

        def reset(self, **options):
            self.queue = [np.zeros(3, np.float32)] * 2
            return self.env.reset(**options)

        def step(self, action):
            self.queue.append(action)
            return self.env.step(self.queue.pop(0))

    told = {}
    for delay in (0.08, 0.0):
        late = sw.CBFActionFilter(Late(env), [ways], plant=sw.MujocoPlant(delay_s=delay))
        told[delay] = drive(late, GoalSeeking, episodes=4, seed=1)
    assert told[0.08]["unflagged"] == 0 and told[0.08]["collisions"] <= 1, told
    assert told[0.0]["collisions"] >= 3 and told[0.0]["flagged"] > 5 * told[0.08]["flagged"], told


def test_a_permission_and_ways_out_together_stop_where_it_is_safe_to():
    env = sw.OcclusionPenalty(
        gym.make("OccludedCrossing-v0"),
        CARS,
        sw.occlusion.Sensor("eye", view_deg=120, range_m=6.0),
        tolerance=0.8,
    )
    both = [
        sw.constraints.EscapeClearance("robot", [sw.constraints.TrackedDiscs(0.4)], 0.2),
        sw.constraints.TrackPermission("robot", 3.0, creep=0.4),
    ]
    filtered = sw.CBFActionFilter(env, both)
    filtered.reset(seed=2)
    told = drive(filtered, GoalSeeking, episodes=1, steps=250)
    assert told["collisions"] == 0 and told["changed"] > 20, told


def test_a_clearance_from_tracks_and_one_from_walls_in_one_projection():
    robotics = pytest.importorskip("gymnasium_robotics")
    gym.register_envs(robotics)

    class Patrolled(gym.Wrapper):
        """A ball that rolls to and fro in the maze's upper corridor; nothing stops it."""

        x, v = 0.0, 0.8

        @property
        def patrol(self):
            return np.array([[self.x, 1.0]])

        def reset(self, **options):
            self.x, self.v = 0.0, 0.8
            return self.env.reset(**options)

        def step(self, action):
            self.x += self.v * 0.01
            if abs(self.x) > 1.2:
                self.v = -self.v
            return self.env.step(action)

    env = sw.OcclusionPenalty(
        Patrolled(gym.make("PointMaze_UMaze-v3")),
        [sw.occlusion.Track(published="patrol", acceleration_noise=[2.0, 0.0], start_velocity_std=1.0)],
        sw.occlusion.Sensor(site="particle_site", position_std=0.02),
        tolerance=1.0,
    )
    filtered = sw.CBFActionFilter(
        env,
        [
            sw.constraints.WallClearance(velocity_clip=5.0),
            sw.constraints.Clearance(
                [sw.constraints.TrackedDiscs(0.15, 2.0)], bodies=["particle"], braking=4.0, radius=0.1
            ),
        ],
    )
    filtered.reset(seed=0)
    raw, nearest, changed = filtered.unwrapped, np.inf, 0
    for _ in range(400):
        way = env.get_wrapper_attr("patrol")[0] - raw.data.qpos
        info = filtered.step(np.clip(5.0 * way, -1, 1).astype(np.float32))[4]
        changed += info["cbf/intervened"]
        nearest = min(nearest, np.linalg.norm(env.get_wrapper_attr("patrol")[0] - raw.data.qpos))
    assert nearest > 0.25 and changed > 20, (nearest, changed)
