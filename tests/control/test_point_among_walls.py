"""A point among walls: the braking path against single physics steps, and the facts that the proof stands on."""

import math

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st

from safe_wrappers.control.backup import point_among_walls as of
from safe_wrappers.control.backup.damped_axis import damped_axis
from safe_wrappers.control.backup.point_among_walls import PointAmongWalls, PointMotion

WALLS = [(-3.0, 3.0, -3.0, -2.0), (-3.0, 3.0, 2.0, 3.0), (-3.0, -2.0, -2.0, 2.0), (2.0, 3.0, -2.0, 2.0)]
BLOCK = (-0.5, 0.5, -0.5, 0.4)
CLIP = 5.0


def among(clip_known, substeps=1, walls=(*WALLS, BLOCK)):
    clip = CLIP if clip_known else math.inf
    x_axis = damped_axis(0.998, 0.24 / substeps, 0.01, substeps, -1.0, 1.0, clip)
    y_axis = damped_axis(0.99, 0.2 / substeps, 0.01, substeps, -0.7, 0.9, clip)
    return PointAmongWalls(x_axis, y_axis, np.array(walls, dtype=np.float64).reshape(-1, 4), clip_known)


MOTIONS = st.builds(
    PointMotion, st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), st.floats(-6.0, 6.0), st.floats(-6.0, 6.0)
)
CONTROLS = st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))


def truth(point, motion, control, clip):
    """Every physics step of one control step of an env that clips the speed at its start."""
    x, y = motion.x, motion.y
    vx, vy = (min(max(v, -clip), clip) for v in (motion.vx, motion.vy))
    ax, ay = point.x_axis, point.y_axis
    ux, uy = min(max(control[0], ax.low), ax.high), min(max(control[1], ay.low), ay.high)
    out = []
    for _ in range(ax.substeps):
        vx, vy = ax.decay * vx + ax.gain * ux, ay.decay * vy + ay.gain * uy
        x, y = x + ax.timestep * vx, y + ay.timestep * vy
        out.append(PointMotion(x, y, vx, vy))
    return out


def braking(point, motion, clip):
    steps = []
    while abs(motion.vx) + abs(motion.vy) > 1e-12:
        steps += truth(point, motion, of.brake(point, motion), clip)
        motion = steps[-1]
    return steps


def inside(r, p, slack=1e-9):
    return r[0] - slack <= p.x <= r[1] + slack and r[2] - slack <= p.y <= r[3] + slack


def from_walls(point, p):
    return min(
        math.hypot(max(a - p.x, p.x - b, 0.0), max(c - p.y, p.y - d, 0.0)) for a, b, c, d in point.walls
    )


@given(MOTIONS, st.sampled_from([1, 4]))
def test_the_path_of_rectangles_contains_every_physics_step_of_braking(motion, substeps):
    point = among(True, substeps)
    boxes = of.path(point, of.clipped(point, motion))
    steps = braking(point, motion, CLIP)
    for k, place in enumerate(steps):
        assert inside(boxes[min(k // substeps, len(boxes) - 1)], place)
    assert all(inside(of.stop(point, motion), place) for place in steps)


@given(MOTIONS, st.sampled_from([1, 4]), st.booleans())
def test_no_physics_step_of_braking_is_closer_than_the_distance(motion, substeps, clip_known):
    point = among(clip_known, substeps)
    steps = [motion, *braking(point, motion, CLIP)]
    distance = of.distance(point, of.clipped(point, motion))
    assert min(from_walls(point, p) for p in steps) >= distance - 1e-9


@given(MOTIONS, st.sampled_from([1, 4]), st.booleans())
def test_braking_for_one_hold_never_loses_distance_and_is_clear(motion, substeps, clip_known):
    point = among(clip_known, substeps)
    motion = of.clipped(point, motion)
    distance = of.distance(point, motion)
    assume(distance > 0.0)
    stop = of.brake(point, motion)
    assert of.distance(point, of.clipped(point, of.step(point, motion, *stop))) >= distance - 1e-9
    assert of.clear(point, motion, *stop, distance - 1e-9)


@given(MOTIONS, CONTROLS, st.sampled_from([1, 4]), st.booleans(), st.floats(0.05, 0.2))
def test_a_clear_control_stays_clear_and_leads_back_inside(motion, control, substeps, clip_known, room):
    point = among(clip_known, substeps)
    start = of.clipped(point, motion)
    assume(of.distance(point, start) >= room and of.clear(point, start, *control, room))
    steps = truth(point, motion, control, CLIP)
    assert min(from_walls(point, p) for p in steps) >= room - 1e-9
    assert of.distance(point, of.clipped(point, steps[-1])) >= room - 1e-9


@given(MOTIONS, CONTROLS, st.floats(0.5, 6.0), st.floats(0.05, 0.2))
def test_without_the_clip_s_level_every_clip_is_covered(motion, control, clip, room):
    # Down to 0.5 m/s: one hold of full force reverses at most 0.24 m/s.
    point = among(False)
    assume(of.distance(point, motion) >= room and of.clear(point, motion, *control, room))
    end = truth(point, motion, control, clip)[-1]
    assert from_walls(point, end) >= room - 1e-9
    assert of.distance(point, end) >= room - 1e-9
