"""What no constraint and no obstacle can be made of, or bound to, is refused with what to give instead."""

from collections.abc import Sequence
from dataclasses import fields

import gymnasium as gym
import numpy as np
import pytest
from judged_loops import slider

import safe_wrappers as sw
from safe_wrappers import constraints as of
from safe_wrappers.errors import ConfigurationError, UnknownNameError, UnsupportedEnvError
from safe_wrappers.filter.bound import Bound

DISC, SPHERE = of.Disc([0.0, 0.0], 1.0), of.Sphere([0.0, 0.0, 0.0], 1.0)
CARS = of.TrackedDiscs(0.4, attribute="car_tracks")
NO_TRACKS = of.TrackedDiscs(0.4, attribute="car_radius")
UNLIMITED = {"lower": None, "upper": None, "joints": ["joint0"]}
TOUCH = {"bodies": ["fingertip"], "against": ["sideE"]}
SQUARE = [[0, 0], [1, 1], [0, 1]]
TIP = {"body": "fingertip", "directions": "xy"}
RIGHT = {
    of.Barrier: {"h": lambda x: 1.0 - x[0] ** 2},
    of.Box: {"center": [0.0, 0.0], "half_size": [1.0, 1.0]},
    of.Clearance: {"obstacles": [DISC], "braking": 1.0},
    of.CoastingClearance: {"keep_out": [DISC]},
    of.ContactFeasibility: {},
    of.Disc: {"center": [0.0, 0.0], "radius": 1.0},
    of.EscapeClearance: {"body": "robot", "obstacles": [CARS]},
    of.HeadingDriveClearance: {"obstacles": [DISC]},
    of.ImpactSpeedLimit: {**TOUCH, "force_limit": 100.0, "stiffness": 1e4},
    of.JointPositionLimit: {"lower": -1.0, "upper": 1.0},
    of.JointSpeedLimit: {"limit": 4.0},
    of.Plane: {"point": [0.0, 0.0], "normal": [1.0, 0.0]},
    of.PredictiveShield: {"h": lambda seen: 1.0, "horizon": 1, "backup": "zero"},
    of.SingularityMargin: {"threshold": 1e-3, **TIP},
    of.SpeedLimit: {"limit": 1.0},
    of.Stance: {},
    of.SupportMargin: {"inset": 0.1},
    of.TrackPermission: {"body": "robot", "braking": 3.0},
    of.TrackedDiscs: {"radius": 0.4},
    of.Traction: {"wheels": ["front_left"]},
    of.WallClearance: {},
    of.Workspace: {"low": [0.0, 0.0, 0.0], "bodies": ["fingertip"]},
}


NUMBERS = float, int, float | None, float | Sequence[float]
MAY_BE_0 = (
    *("margin", "state_error", "tolerance", "uncertainty", "sigmas", "candidates"),
    "max_decrease_per_speed",
)


def options(*types):
    """Every kind with each of its fields of one of the types."""
    found = [(kind, field) for kind in RIGHT for field in fields(kind) if field.init and field.type in types]
    return pytest.mark.parametrize(("kind", "name"), [(kind, field.name) for kind, field in found])


@options(*NUMBERS)
def test_a_number_that_is_none_or_negative_is_refused_by_its_name(kind, name):
    kind(**RIGHT[kind])
    radius_0 = name == "radius" and hasattr(kind, "margin")  # of a machine, not of a disc
    for wrong in (np.nan, np.inf, "much", -1, [[1.0]], *([] if name in MAY_BE_0 or radius_0 else [0])):
        with pytest.raises(ConfigurationError, match=name):
            kind(**RIGHT[kind] | {name: wrong})


@options(bool)
def test_what_is_neither_true_nor_false_is_refused_by_its_name(kind, name):
    kind(**RIGHT[kind] | {name: True})
    for wrong in ("no", 1, None):
        with pytest.raises(ConfigurationError, match=name):
            kind(**RIGHT[kind] | {name: wrong})


MADE = [
    (of.Barrier, {"h": 4.0}, "h must be a function of the state, got 4.0"),
    (of.Box, {"half_size": [1, 1, 1]}, "half_size must be 2 finite numbers"),
    (of.Clearance, {"obstacles": []}, "obstacles is a list with at least one obstacle"),
    (of.Clearance, {"obstacles": ["wall"]}, "expected an obstacle .* got 'wall'"),
    (of.CoastingClearance, {"horizon": 1}, "at least 2"),
    (of.JointPositionLimit, {"lower": np.nan}, "lower is a position"),
    (of.SpeedLimit, {"direction": ""}, "no direction ''"),
    (of.Workspace, {"high": [np.nan, 0.0, 0.0]}, "high must be finite"),
    (of.Plane, {"point": [0.0] * 4}, "point must be 1 or 2 or 3 finite numbers"),
    (of.PredictiveShield, {"backup": 0.5}, "backup is zero, hold"),
    (of.Clearance, {"position": [0] * 4, "velocity": [1] * 4}, "up to three"),
    (of.Clearance, {"position": [0], "velocity": [1, 2]}, "position and velocity .* in the same order"),
    (of.CoastingClearance, {"keep_out": []}, "keep_out .* or untouched"),
    (of.CoastingClearance, {"keep_out": [of.Plane([0.0], [1.0])]}, "holds Disc and Discs, got Plane"),
    (of.CoastingClearance, {"keep_out": [of.Discs("a", 1.0, "v")]}, "past discs that stand still"),
    (of.HeadingDriveClearance, {"obstacles": [of.Discs("a", 1.0, "v")]}, "past discs that stand still"),
    (of.CoastingClearance, {"untouched": [DISC]}, "untouched needs the machine's outline"),
    (of.CoastingClearance, {"outline": SQUARE}, "keep_out is for the body's origin alone"),
    (of.CoastingClearance, {"untouched": [DISC], "outline": SQUARE[:2]}, "not on one line"),
    (of.EscapeClearance, {"obstacles": [SPHERE]}, "obstacles holds TrackedDiscs and Discs"),
    (of.EscapeClearance, {"obstacles": [of.Plane([0, 0, 0], [0, 0, 1])]}, "seen from above"),
    (of.HeadingDriveClearance, {"obstacles": []}, "obstacles .* or untouched"),
    (of.HeadingDriveClearance, {"untouched": [DISC]}, "untouched needs the robot's parts"),
    (of.HeadingDriveClearance, {"parts": [[0.0, 0.1]]}, "parts are for untouched alone"),
    (of.HeadingDriveClearance, {"untouched": [DISC], "parts": [[0.1, 0.0]]}, r"\[\[ahead, radius\]"),
    (of.HeadingDriveClearance, {"untouched": [DISC], "parts": [0.1, 0.1]}, r"\[\[ahead, radius\]"),
    (of.JointSpeedLimit, {"joints": []}, "joints is a list of names, or None"),
    (of.ImpactSpeedLimit, {"margin": 100.0}, "the margin 100.0 N leaves nothing of the limit 100.0 N"),
    (of.PredictiveShield, {"h": 3}, "h is a function"),
    (of.PredictiveShield, {"backup": "brake"}, "no backup 'brake'"),
    (of.PredictiveShield, {"backup": []}, "a list with at least one"),
    (of.PredictiveShield, {"terminal": 1.0}, "terminal is a function or None, got 1.0"),
    (of.PredictiveShield, {"sees": "all"}, "sees is one of observation, env, view"),
    (of.SingularityMargin, {"threshold": None}, "give a threshold .*, or a task_speed and a rate_limit"),
    (of.SingularityMargin, {"body": None}, "name the one site, body or geom .*site=None"),
    (of.SingularityMargin, {"directions": "xw"}, 'directions is some of "xyz"'),
    (of.SpeedLimit, {"margin": 1.0}, "the margin 1.0 leaves nothing of the limit 1.0"),
    (of.SpeedLimit, {"average": "mean"}, "no average 'mean'; choose step or substep"),
    (of.Stance, {"friction_share": 1.1}, r"\(0, 1\]"),
    (of.Stance, {"cone": "round"}, "pyramid"),
    (of.TrackPermission, {"tracks": "car0"}, "list of names"),
    (of.Traction, {"max_slip": 1.0}, r"\(0, 1\)"),
    (of.Traction, {"margin": 0.15}, "margin must be below max_slip = 0.15, got 0.15"),
    (of.Workspace, {"low": None}, r"give a bound in low or high \(m\), or something to keep_out of"),
    (of.Workspace, {"low": [0.0, 1.0]}, r"low is \[x, y, z\] in m, None where there is no"),
    (of.Workspace, {"high": [1.0, 1.0, 1.0], "radius": 0.3, "margin": 0.2}, "nothing is left of the box"),
    (of.Workspace, {"bodies": "fingertip"}, "bodies is a list of names; got"),
]


@pytest.mark.parametrize(("kind", "wrong", "words"), MADE)
def test_it_is_not_made_of(kind, wrong, words):
    with pytest.raises(ConfigurationError, match=words):
        kind(**RIGHT[kind] | wrong)


BOUND = {
    ("OccludedCrossing-v0", UnknownNameError): [
        (of.EscapeClearance, {"body": "robo"}, "robo.*robot, car0"),
        (of.EscapeClearance, {"obstacles": [of.TrackedDiscs(0.4)]}, "no attribute 'tracking'"),
        (of.TrackPermission, {}, "track_names"),
        (of.TrackPermission, {"body": "robo"}, "robo.*robot, car0"),
    ],
    ("OccludedCrossing-v0", ConfigurationError): [
        (of.EscapeClearance, {"body": "car0"}, "two slides"),
        (of.EscapeClearance, {"obstacles": [NO_TRACKS]}, "OcclusionPenalty inside"),
    ],
    ("SafeCarGoal1-v0", ConfigurationError): [
        (of.CoastingClearance, {"robot_model_attr": "agent_position"}, "holds an MjModel"),
    ],
    ("SafeRover-v0", UnknownNameError): [
        (of.Traction, {"wheels": ["front_lft"]}, "no joint 'front_lft'; it has: .*front_left"),
    ],
    ("SafeRover-v0", ConfigurationError): [
        (of.Traction, {"wheels": ["steer_left"]}, "'steer_left' is no driven wheel"),
        (of.Traction, {"wheels": ["front_left", "front_left"]}, "each once"),
        (of.Traction, {"wheels": []}, r"each once, got \[\]"),
    ],
    ("Reacher-v5", UnknownNameError): [
        (of.ImpactSpeedLimit, {"bodies": ["hand"]}, "no body or geom 'hand'; bodies: world.*fingertip"),
        (of.SingularityMargin, {"joints": ["elbow"]}, "no joint 'elbow'"),
        (of.SpeedLimit, {"body": "belly"}, "no body 'belly'; it has: world, body0"),
        (of.Workspace, {"geoms": ["tip"]}, "no geom 'tip'; it has: .*fingertip"),
    ],
    ("Reacher-v5", UnsupportedEnvError): [
        (of.ContactFeasibility, {}, "no body of this model"),
        (of.Stance, {}, "nothing to stand on"),
        (of.WallClearance, {}, "two slides.*Use Clearance"),
    ],
    ("Reacher-v5", ConfigurationError): [
        (of.Clearance, {}, "name the bodies, sites or geoms .*fingertip"),
        (of.ImpactSpeedLimit, {"against": ["body0"]}, "'body0' is part of the machine itself"),
        (of.JointPositionLimit, {"lower": 2.0}, "nothing is left of the range of joint 'joint0': 2 to 1"),
        (of.JointPositionLimit, UNLIMITED, "none of these joints has a range in the model: pass lower"),
        (of.SingularityMargin, {"threshold": 0.02}, "no configuration has .*above 0.02 .*is 0.011, half"),
        (of.Workspace, {"bodies": []}, "name the bodies, sites or geoms"),
    ],
}


@pytest.mark.parametrize(
    ("env_id", "error", "kind", "wrong", "words"),
    [(*where, *row) for where, rows in BOUND.items() for row in rows],
)
def test_it_is_not_bound_to(env_id, error, kind, wrong, words):
    with pytest.raises(error, match=words):
        sw.CBFActionFilter(gym.make(env_id), [kind(**RIGHT[kind] | wrong)])


ANY_PLANT = of.Barrier, of.Clearance, of.PredictiveShield
FOR_A_MODEL = [kind for kind in RIGHT if issubclass(kind, sw.Constraint) and kind not in ANY_PLANT]


@pytest.mark.parametrize("kind", FOR_A_MODEL)
def test_an_analytic_plant_has_no_model_for_it(kind):
    plant = sw.AnalyticPlant(
        f=lambda x: x, g=lambda x: np.ones((1, 1)), state=lambda env: env.state, control_dt=0.1
    )
    with pytest.raises(UnsupportedEnvError, match=r"MujocoPlant|AnalyticPlant"):
        Bound(kind(**RIGHT[kind]), plant)


def test_a_clearance_on_an_analytic_plant_needs_to_know_where_the_point_is():
    plant = sw.AnalyticPlant(
        f=lambda x: np.zeros(2), g=lambda x: np.ones((2, 1)), state=lambda env: np.zeros(2), control_dt=0.05
    )
    with pytest.raises(ConfigurationError, match="say where the point is in the state"):
        sw.CBFActionFilter(slider(), [of.Clearance([DISC], 1.0)], plant=plant)


def test_a_slip_is_not_limited_under_a_delay():
    with pytest.raises(ConfigurationError, match="use delay_s=0"):
        plant = sw.MujocoPlant(delay_s=0.02)
        sw.CBFActionFilter(gym.make("SafeRover-v0"), [of.Traction(["front_left"])], plant=plant)


def test_steps_longer_than_the_horizon_and_wheels_limited_twice_are_refused():
    slow = gym.make("OccludedCrossing-v0")
    slow.unwrapped.frame_skip = 100
    with pytest.raises(ConfigurationError, match="too short for steps of 1 s"):
        sw.CBFActionFilter(slow, [of.EscapeClearance("robot", [CARS], horizon_s=0.9)])
    axles = [of.Traction([f"{axle}_left", f"{axle}_right"]) for axle in ("front", "rear")]
    with pytest.raises(ConfigurationError, match="2 times"):
        sw.CBFActionFilter(gym.make("SafeRover-v0"), axles)
