"""Which models are a point on two slides among walls, what is read from them, and which are refused, by name."""

import mujoco
import pytest
from asking import bound
from scenes import Scene

from safe_wrappers.errors import UnsupportedEnvError
from safe_wrappers.plants.mujoco.planar_point import planar_point, walls

SLIDES = '<joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>'
BALL = '<geom type="sphere" size="0.1"/>'
MOTORS = '<motor joint="x" ctrlrange="-1 2" gear="10"/><motor joint="y" ctrlrange="-3 1" gear="5"/>'
WALL = '<geom name="wall" type="box" pos="2 0 0" size="0.5 1 0.2"/>'


def xml(slides=SLIDES, ball=BALL, motors=MOTORS, world=WALL, option="", body=""):
    return f"""
    <mujoco>
      <option timestep="0.01" gravity="0 0 0" {option}/>
      <default><joint damping="1"/><geom margin="0.002"/></default>
      <worldbody>
        {world}
        <body name="point" pos="0.5 -0.25 0" {body}>{slides}{ball}</body>
      </worldbody>
      <actuator>{motors}</actuator>
    </mujoco>"""


def observing(text):
    plant = bound(Scene(text, frame_skip=2))
    plant.observe()
    return plant


def test_the_point_is_found():
    plant = observing(xml())
    point = planar_point(plant, clip=4.0)
    assert plant.model.body(point.body).name == "point"
    assert (point.joints, point.actuators, point.origin.tolist()) == ([0, 1], [0, 1], [0.5, -0.25])
    mass = plant.model.body_mass[point.body]
    for axis, gear, low, high in zip(point.axes, (10, 5), (-1, -3), (2, 1), strict=True):
        # MuJoCo's semi-implicit Euler step with implicit joint damping 1.
        assert axis.decay == pytest.approx(mass / (mass + 0.01))
        assert axis.gain == pytest.approx(0.01 * gear / (mass + 0.01))
        assert (axis.low, axis.high, axis.clip, axis.substeps, axis.timestep) == (low, high, 4.0, 2, 0.01)


YAW = '<joint name="yaw" type="hinge" axis="0 0 1"/>'
ONE_SLIDE, ONE_MOTOR = SLIDES.split("/>")[0] + "/>", MOTORS.split("/>")[0] + "/>"
LIMITED = SLIDES.replace('"0 1 0"', '"0 1 0" range="-1 1" limited="true"')
SPRINGS = SLIDES.replace('type="slide"', 'type="slide" stiffness="4"')
TWO_MOTORS = MOTORS + '<motor joint="x" ctrlrange="-1 1"/>'
ALONE = [
    ({"slides": SLIDES.replace("slide", "hinge")}, "hinge"),
    ({"slides": "<freejoint/>", "motors": ""}, "free"),
    ({"slides": SLIDES.replace("0 1 0", "0 0 1")}, "world x and world y"),
    ({"slides": SLIDES.replace("1 0 0", "-1 0 0")}, "world x and world y"),
    ({"body": 'euler="0 0 30"'}, "world x and world y"),
    ({"slides": LIMITED}, "no limits"),
    ({"motors": ONE_MOTOR}, "actuator of its own"),
    ({"motors": TWO_MOTORS}, "actuator of its own"),
    ({"ball": BALL + '<site name="s"/>', "motors": MOTORS + '<motor site="s"/>'}, "no other actuator"),
    ({"motors": MOTORS.replace("-1 2", "0 2")}, "push both ways"),
    ({"motors": MOTORS.replace('gear="10"', 'gear="-10"')}, "gear above zero"),
    ({"motors": MOTORS.replace("<motor joint", '<position kp="3" joint')}, "is .* off that"),
    ({"slides": SPRINGS}, "springs"),
    ({"slides": SLIDES.replace('type="slide"', 'type="slide" frictionloss="1"')}, "friction"),
    ({"option": 'integrator="RK4"'}, "Euler"),
    ({"option": 'density="1000" viscosity="1"'}, "is .* off that"),
    ({"world": WALL + '<body><freejoint/><geom size="0.1"/></body>'}, "nothing else that moves"),
    ({"ball": BALL + '<body><joint type="hinge"/><geom size="0.1"/></body>'}, "nothing else that moves"),
]
AMONG_OTHERS = [
    ({"slides": ONE_SLIDE, "motors": ONE_MOTOR}, "it has 1"),
    ({"world": '<body><freejoint/><geom size="0.1"/></body>'}, "before any free or ball joint"),
    ({"slides": YAW + SLIDES}, "is .* off that"),
    ({"slides": SLIDES + YAW, "ball": BALL.replace("size", 'pos="0.2 0 0" size')}, "is .* off that"),
    ({"ball": BALL + f'<body>{YAW}<geom pos="0.2 0 0" size="0.1"/></body>'}, "is .* off that"),
    ({"motors": TWO_MOTORS}, "only one"),
]
"""What is no point mass on two slides, alone or as the named body among other things that move."""


@pytest.mark.parametrize(
    ("changed", "says", "name"),
    [*((*one, None) for one in ALONE), *((*one, "point") for one in AMONG_OTHERS)],
)
def test_other_machines_are_refused_with_the_reason_and_the_alternative(changed, says, name):
    with pytest.raises(UnsupportedEnvError, match=f"(?s){says}.*Use Clearance"):
        planar_point(observing(xml(**changed)), 5.0, name)


def found(world, ball=BALL):
    plant = observing(xml(world=world, ball=ball))
    return walls(plant.model, plant.named("body", "point"))


def test_a_box_is_a_wall_and_reach_is_where_a_contact_is_reported():
    (wall,), reach = found(WALL)
    assert wall == pytest.approx((1.5, 2.5, -1.0, 1.0))
    assert found(WALL, BALL.replace("/>", ' pos="0 0 0.15"/>'))[1] == reach  # seen from above
    plant = observing(xml())
    data = mujoco.MjData(plant.model)
    # Versions of MuJoCo differ in whether two contact margins add up: between these two a contact may be reported.
    for distance, contacts in ((reach + 1e-6, 0), (0.102 - 1e-6, 1)):
        data.qpos[:] = [1.5 - distance - 0.5, 0.25]  # qpos counts from the body's own place
        mujoco.mj_forward(plant.model, data)
        assert data.ncon == contacts


@pytest.mark.parametrize(
    "world",
    [
        '<geom type="plane" size="9 9 1" pos="0 0 -0.1"/>',
        WALL.replace('name="wall"', 'contype="0" conaffinity="0"'),
        WALL.replace("2 0 0", "2 0 0.4"),
        WALL.replace("2 0 0", "2 0 -0.4"),
    ],
    ids=["floor", "does not collide", "above", "below"],
)
def test_what_cannot_be_run_into_is_left_out(world):
    assert found(world)[0] == []


@pytest.mark.parametrize(
    ("world", "says"),
    [
        (WALL.replace("<geom", '<geom euler="0 0 20"'), "'wall' .box."),
        ('<geom name="pillar" type="cylinder" pos="2 0 0" size="0.2 0.2"/>', "'pillar' .cylinder."),
        ('<geom name="side" type="plane" size="1 1 1" euler="0 90 0" pos="2 0 0"/>', "'side' .plane."),
        (f'<body mocap="true">{WALL}</body>', "'wall' can be run into and moves"),
    ],
)
def test_what_is_no_wall_along_x_and_y_is_refused_by_name(world, says):
    with pytest.raises(UnsupportedEnvError, match=f"(?s){says}.*Use Clearance"):
        found(world)
