"""Every exported constraint and obstacle is plain data: what it was given survives JSON, every argument of it."""

import json
import math
from dataclasses import MISSING, fields

import gymnasium as gym
import pytest
from gymnasium.envs.registration import EnvSpec

import safe_wrappers as sw
from safe_wrappers import constraints as of
from safe_wrappers.constraints.obstacles import obstacles_from
from safe_wrappers.errors import UnknownNameError
from safe_wrappers.wrappers.serialize import constraint_from, plain_data

OBSTACLES = [
    of.Box([1.0, 0.0, 0.0], [0.1, 0.2, 0.3]),
    of.Disc([0.1, 0.2], 0.05),
    of.Discs("centres", 0.1, "velocities"),
    of.Plane([0.0, 0.25], [0.0, -1.0]),
    of.Sphere([0.12, 0.05, 0.01], 0.03),
    of.TrackedDiscs(0.3, 2.0, 0.5, "car_tracks"),
]
DISC, DISCS, SQUARE = OBSTACLES[1], OBSTACLES[2], [[0.1, 0.1], [-0.1, 0.1], [-0.1, -0.1], [0.1, -0.1]]
CONSTRAINTS = [
    of.Clearance(OBSTACLES[3:4], 24.0, bodies=["tool"], radius=0.015, margin=0.1, state_error=0.01),
    of.Clearance(OBSTACLES[3:4], 24.0, sites=["tip"], geoms=["link0"]),
    of.Clearance([DISC], 2.0, position=[0, 1], velocity=[2, 3]),
    of.CoastingClearance([DISC], [of.Discs("vases", 0.1)], SQUARE, "car", "model", 0.01, 20, 0.1, 0.5, True),
    of.ContactFeasibility(0.6, 0.02),
    of.EscapeClearance("robot", [OBSTACLES[5], DISCS, OBSTACLES[3]], 0.2, 0.1, 2.0),
    of.HeadingDriveClearance(
        [of.Discs("hazards", 0.2)], "robot", 0.004, 0.01, 0.1, True, [of.Discs("vases", 0.1)], [[0.1, 0.05]]
    ),
    of.ImpactSpeedLimit(["body1"], ["sideE"], 100.0, 1e4, 1.0, 4),
    of.JointPositionLimit([-1.0, -math.inf], 2.0, ["joint1", "joint0"], 0.1, 7, 0.5),
    of.JointSpeedLimit([4.0, 3.0], ["joint1", "joint0"], 0.1, 2, 0.5),
    of.SingularityMargin(
        0.003, body="fingertip", directions="xy", joints=["joint0", "joint1"], margin=0.1, max_decrease=2.0
    ),
    of.SingularityMargin(geom="tip", task_speed=0.1, rate_limit=6.0, horizon=7),
    of.SingularityMargin(0.003, site="grip"),
    of.SpeedLimit(1.5, "torso", "-x", "substep", 0.1, 4, 0.7, 0.6, True),
    of.Stance(0.6, "exact"),
    of.SupportMargin(0.02),
    of.TrackPermission("robot", 3.0, ("car0",)),
    of.Traction(["left", "right"], 0.1, 0.3, 0.4, 0.01),
    of.WallClearance(0.02, 4.0),
    of.Workspace(
        [None, -0.5, None], [0.5, None, None], [DISC, *OBSTACLES[:3:2]], ["tip"], radius=0.01, margin=0.02
    ),
    of.Workspace(high=[1.0, 1.0, 1.0], sites=["grip"], geoms=["link0"], horizon=7, max_decrease=0.3),
]
HOLD_FUNCTIONS = {"Barrier", "PredictiveShield"}
"""So that `gym.make(env.spec)` has them again, and JSON not."""
given = pytest.mark.parametrize("given", CONSTRAINTS + OBSTACLES, ids=repr)


def test_every_exported_one_is_here_and_says_what_it_promises():
    named = {type(one).__name__ for one in CONSTRAINTS + OBSTACLES} | HOLD_FUNCTIONS
    assert named == set(of.__all__)
    proved = {type(one).__name__ for one in CONSTRAINTS if one.promise == "proved"}
    assert proved == {"CoastingClearance", "WallClearance"}  # the heading drive there has an uncertainty
    assert of.HeadingDriveClearance([of.Disc([0.0, 0.0], 1.0)]).promise == "proved"
    assert {one.promise for one in CONSTRAINTS} == {"proved", "best effort"}


def test_every_argument_is_given_another_value_than_its_own_somewhere():
    for kind in {type(one) for one in CONSTRAINTS + OBSTACLES}:
        for field in fields(kind):
            if field.init and field.default is not MISSING:
                values = [getattr(one, field.name) for one in CONSTRAINTS + OBSTACLES if type(one) is kind]
                assert any(value != field.default for value in values), (kind.__name__, field.name)


@given
def test_it_survives_json(given):
    again = constraint_from if isinstance(given, sw.Constraint) else lambda data: obstacles_from([data])[0]
    rebuilt = again(json.loads(json.dumps(plain_data(given))))
    assert rebuilt == given and type(rebuilt) is type(given)
    with pytest.raises(UnknownNameError, match="no_such"):
        again(plain_data(given) | {"no_such": 1})


def test_what_a_constraint_finds_on_its_plant_is_told_and_found_again_by_a_filter_made_again():
    limit = of.SingularityMargin(body="fingertip", directions="xy", task_speed=0.1, rate_limit=5.0, horizon=3)
    env = sw.CBFActionFilter(gym.make("Reacher-v5"), [limit])
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.constraints[0].validated == env.constraints[0].validated is not None
