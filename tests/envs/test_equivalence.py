"""One-step equivalence with Safety-Gymnasium: every step of four recorded episodes, from its state.

The recordings are of Safety-Gymnasium 1.2 on MuJoCo 2.3.3; ours runs on a MuJoCo of today. The tables
of the worst errors are in docs/tasks/equivalence.md. What is left, and why:

* Vases slower than 1e-7 m/s are asleep here, and creep on there. With sleeping off, the velocities agree to 5e-11.
* Nose (a box) touches a vase (a box): MuJoCo 2.3.3 reported half of the true penetration wherever the touched
  face belongs to the second box, the vase; versions from 3.4 on report all of it. Putting the half back makes these
  steps agree to 1e-11. We keep the right depth: a pushed vase moves differently, the robot hardly (a vase has
  0.15 % of its mass), the cost not at all.
* From MuJoCo 3.12 on another algorithm finds where two boxes touch. In 11 of the 54 steps it reports other points:
  in step 222, say, one corner of the nose on the vase instead of two. The other 43 agree as before.
* Level 2, episode 2, step 206: the nose meets a vase that stands exactly upright, and 2.3.3 reports a third
  contact at the vase's foot, 5 cm below the nose.
* Level 2, episode 2, step 252: 2.3.3's solver stopped early in one substep. With a tolerance of 1e-12 instead
  of 1e-8, 2.3.3 gives what we give.

(Our own MJCF run on 2.3.3 repeats all 1200 steps to 1e-11; tried by hand.)
"""

import mujoco
import pytest
from recordings import (
    EPISODES,
    HALVES_ITSELF,
    OTHER_CORNERS,
    Recording,
    forward_as_2_3_3,
    replay,
    step_as_2_3_3,
)

FREE = {"position": 5e-9, "velocity": 5e-7, "sensors": 1e-7, "lidar": 5e-9, "reward": 1e-12, "cost": 0.0}
"""Equivalence: some three times the worst measured."""
TOUCHING = {"position": 4e-3, "velocity": 2.0, "sensors": 20.0, "lidar": 6e-3, "reward": 4e-5, "cost": 0.0}
"""Bounds on what another penetration depth changes in one step: for a vase, not for the robot."""
CORNERS = TOUCHING | {"lidar": 2.5e-2}
"""Bounds on what other contact points change."""
OTHER = {(2, 2): {207, 208, 215, 216, 217, 218, 219, 221, 222, 226, 227}} if OTHER_CORNERS else {}
"""Level and episode, and the steps in which this MuJoCo lets two boxes touch elsewhere."""
SINGULAR = {(2, 2, 206): "2.3.3 adds a contact", (2, 2, 252): "2.3.3's solver stopped early"}
"""Level, episode and step of the two that differ for reasons of their own."""


def worst(errors):
    """Largest error per quantity over steps; zeros for no steps."""
    return {name: max((getattr(e, name) for e in errors), default=0.0) for name in FREE}


def assert_within(errors, limits):
    for name, error in worst(errors).items():
        assert error <= limits[name], f"{name}: {error:.3g} > {limits[name]:.3g}"


def nose_on_vase(env):
    """Whether the robot's box and a vase are in contact now."""
    nose = env.model.geom("pointarrow").id
    vase = env.model.geom_bodyid >= env.model.body("vase0").id
    pairs = env.data.contact.geom
    return bool(((pairs == nose).any(axis=1) & vase[pairs].any(axis=1)).any())


# The car: what is left there, and why.
#
# * 2.3.3 stopped early: its solver, given a tolerance of 1e-12 instead of 1e-8, gives what we give (tried by
#   hand, on the vases' contacts with the floor).
# * A vase touched: 2.3.3 reported one contact where later versions report up to four (a wheel's rim on a box),
#   and half of the penetration of two boxes (bumper on vase, vase on vase; see `mujoco_2_3_3`). With both put
#   back these steps agree as all others do. We keep today's contacts: a pushed vase moves differently, the car hardly
#   (a vase has 0.03 % of its mass), the cost not at all.
# * MuJoCo 3.3 still halves penetrations itself; level 2, episode 2, steps 99, 165 and 172 are up to 2e-7 m off there,
#   not by its solver's tolerance (tried by hand), all others agree.
# * From MuJoCo 3.12 on another algorithm finds where two boxes touch. In 84 of the steps that touch a vase it reports
#   other points than 2.3.3, which moves vases by up to 16 mm a step, and the car's accelerometer by 10 m/s^2
#   in one of them. The cost is the same in every step.
# * Two vases against each other, level 2, episode 2, steps 218 to 236: their edges and faces meet nearly parallel,
#   and the rule by which 2.3.3 halved a penetration is not ours to guess there.
# * A singular start, level 2, episode 1, step 0: all three wheels stand on the floor at a distance of exactly 0.
#   On 2.3.3, too, the result changes by 5 rad/s when the car is lifted by 1e-16 m (tried by hand).

AGREE = {"position": 5e-9, "velocity": 5e-7, "sensors": 2e-9, "lidar": 5e-9, "reward": 1e-12, "cost": 0.0}
"""Equivalence: some three times the worst measured."""
STOPPED = {"position": 1e-5, "velocity": 2e-3, "sensors": 1e-5, "lidar": 3e-6, "reward": 2e-10, "cost": 0.0}
"""Bounds where 2.3.3's solver stopped early."""
CAR_TOUCHED = {"position": 3e-2, "velocity": 5.0, "sensors": 0.2, "lidar": 6e-2, "reward": 6e-5, "cost": 0.0}
"""Bounds on what other contacts change in one step: for a vase, not for the car."""
CAR_CORNERS = {"position": 5e-2, "velocity": 6.0, "sensors": 30.0, "lidar": 4e-2, "reward": 4e-4, "cost": 0.0}
"""Bounds on what other contact points of two boxes change: some three times the worst measured with 4.0."""
CAR_SINGULAR = (2, 1, 0)
"""Level, episode and step that hangs on the last bit of the start."""
STOPPED_EARLY = {(1, 2): {117, 200, 210}, (2, 2): {63, 76, 168, 183, 185, 189, 190, 237}}
NEARLY_PARALLEL = {(2, 2): set(range(218, 237))}
CAR_OTHER = {
    (1, 2): {97, 98, 100, 101},
    (2, 2): {
        99, 101, 114, 115, 120, 123, 139, 142, 145, 147, 148, 149, 150, 151, 153, 155, 157, 158, 159, 160,
        161, 162, 164, 165, 166, 167, 168, 169, 171, 172, 173, 174, 175, 176, 177, 179, 180, 181, 182, 183,
        184, 185, 187, 189, 190, 191, 192, 193, 194, 198, 199, 200, 201, 202, 203, 204, 205, 212, 213, 214,
        215, 216, 217, 246, 247, 248, 249, 250, 252, 253, 254, 260, 261, 266, 267, 268, 269, 274, 293, 294,
    },
}  # fmt: skip
"""Steps in which two boxes touch elsewhere, from MuJoCo 3.12 on."""
if not OTHER_CORNERS:
    CAR_OTHER.clear()


def vase_touched(env):
    """Whether the car or another vase is in contact with a vase now."""
    vases = env.model.geom_bodyid >= env.model.body("vase0").id
    pairs = env.data.contact.geom
    on_floor = (pairs == env.model.geom("floor").id).any(axis=1)
    return bool((vases[pairs].any(axis=1) & ~on_floor).any())


@pytest.mark.parametrize(("level", "episode"), EPISODES)
def test_every_recorded_step_of_the_point(make_env, monkeypatch, level, episode):
    errors = replay(make_env("Point", level), Recording.load(level, episode), monkeypatch, nose_on_vase)
    regular = [e for t, e in enumerate(errors) if (level, episode, t) not in SINGULAR]
    free = [e for e in regular if not e.touched]
    other = OTHER.get((level, episode), set())
    assert len(free) >= (300 if level == 1 else 270)
    assert_within(free, FREE)
    assert_within([e for t, e in enumerate(errors) if t not in other], TOUCHING)
    assert_within([errors[t] for t in other], CORNERS)


@pytest.mark.parametrize("episode", [1, 2])
def test_penetration_depth_explains_the_steps_of_the_point_at_a_vase(make_env, monkeypatch, episode):
    """With 2.3.3's box-box penetration put back, contact steps agree as well as all others."""
    monkeypatch.setattr(mujoco, "mj_forward", forward_as_2_3_3)
    env = make_env("Point", 2)
    errors = replay(env, Recording.load(2, episode), monkeypatch, nose_on_vase, step_as_2_3_3)
    left_out = OTHER.get((2, episode), set()) | {t for level, e, t in SINGULAR if (level, e) == (2, episode)}
    assert sum(e.touched for e in errors) >= 25
    assert_within([e for t, e in enumerate(errors) if t not in left_out], FREE)


@pytest.mark.parametrize(("level", "episode"), EPISODES)
def test_every_recorded_step_of_the_car(make_env, monkeypatch, level, episode):
    recording = Recording.load(level, episode, "car")
    errors = replay(make_env("Car", level), recording, monkeypatch, vase_touched)
    regular = [(t, e) for t, e in enumerate(errors) if (level, episode, t) != CAR_SINGULAR]
    early, other = STOPPED_EARLY.get((level, episode), set()), CAR_OTHER.get((level, episode), set())
    free = [e for t, e in regular if not e.touched and t not in early]
    assert len(free) == {(1, 1): 300, (1, 2): 220, (2, 1): 299, (2, 2): 100}[level, episode]
    assert_within(free, AGREE)
    assert_within([e for _, e in regular if not e.touched], STOPPED)
    assert_within([e for t, e in regular if t not in other], CAR_TOUCHED)
    assert_within([errors[t] for t in other], CAR_CORNERS)


@pytest.mark.parametrize("level", [1, 2])
def test_other_contacts_explain_the_steps_of_the_car_at_a_vase(make_env, monkeypatch, level):
    """With 2.3.3's contacts put back, these steps agree as well as all others."""
    env = make_env("Car", level)
    for name in ("mjDSBL_NATIVECCD", "mjDSBL_MULTICCD"):  # the latter is a flag to enable, up to 3.3
        if hasattr(mujoco.mjtDisableBit, name):
            env.model.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, name))
    monkeypatch.setattr(mujoco, "mj_forward", forward_as_2_3_3)
    recording = Recording.load(level, 2, "car")
    errors = replay(env, recording, monkeypatch, vase_touched, step_as_2_3_3)
    touched = {t: e for t, e in enumerate(errors) if e.touched}
    assert len(touched) > 70
    early, parallel = STOPPED_EARLY[level, 2], NEARLY_PARALLEL.get((level, 2), set())
    other = CAR_OTHER.get((level, 2), set())
    if HALVES_ITSELF and level == 2:
        early = early | {99, 165, 172}
    assert_within([e for t, e in touched.items() if t not in early | parallel | other], AGREE)
    assert_within([e for t, e in touched.items() if t not in parallel | other], STOPPED)
    assert_within([touched[t] for t in other], CAR_CORNERS)
    for t in parallel & set(touched):
        assert touched[t].velocity < 0.5
        assert touched[t].sensors < (4e-3 if OTHER_CORNERS else 1e-4)  # the car's own
