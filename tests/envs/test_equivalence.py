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

The car: what is left there, and why.

* 2.3.3 stopped early: its solver, given a tolerance of 1e-12 instead of 1e-8, gives what we give (tried by
  hand, on the vases' contacts with the floor).
* A vase touched: 2.3.3 reported one contact where later versions report up to four (a wheel's rim on a box),
  and half of the penetration of two boxes (bumper on vase, vase on vase; see `recordings`). With both put
  back these steps agree as all others do. We keep today's contacts: a pushed vase moves differently, the car hardly
  (a vase has 0.03 % of its mass), the cost not at all.
* MuJoCo 3.3 still halves penetrations itself; level 2, episode 2, steps 99, 165 and 172 are up to 2e-7 m off there,
  not by its solver's tolerance (tried by hand), all others agree.
* From MuJoCo 3.12 on another algorithm finds where two boxes touch. In 84 of the steps that touch a vase it reports
  other points than 2.3.3, which moves vases by up to 16 mm a step, and the car's accelerometer by 10 m/s^2
  in one of them. The cost is the same in every step.
* Two vases against each other, level 2, episode 2, steps 218 to 236: their edges and faces meet nearly parallel,
  and the rule by which 2.3.3 halved a penetration is not ours to guess there.
* A singular start, level 2, episode 1, step 0: all three wheels stand on the floor at a distance of exactly 0.
  On 2.3.3, too, the result changes by 5 rad/s when the car is lifted by 1e-16 m (tried by hand).
"""

import gymnasium as gym
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

LIMITS = {
    ("Point", "agree"): (5e-9, 5e-7, 1e-7, 5e-9, 1e-12, 0.0),
    ("Point", "touched"): (4e-3, 2.0, 20.0, 6e-3, 4e-5, 0.0),
    ("Point", "corners"): (4e-3, 2.0, 20.0, 2.5e-2, 4e-5, 0.0),
    ("Car", "agree"): (5e-9, 5e-7, 2e-9, 5e-9, 1e-12, 0.0),
    ("Car", "stopped"): (1e-5, 2e-3, 1e-5, 3e-6, 2e-10, 0.0),
    ("Car", "touched"): (3e-2, 5.0, 0.2, 6e-2, 6e-5, 0.0),
    ("Car", "corners"): (5e-2, 6.0, 30.0, 4e-2, 4e-4, 0.0),
}
"""Bounds on the errors of `MEASURED`, some three times the worst: of equivalence; where 2.3.3's solver stopped early;
of what another penetration depth changes in one step, for a vase, not for the robot; of what other points do."""
MEASURED = ("position", "velocity", "sensors", "lidar", "reward", "cost")

# Steps by robot, level and episode.
SINGULAR = {("Point", 2, 2): {206, 252}, ("Car", 2, 1): {0}}
"""They differ for reasons of their own: a contact more, a solver that stopped, a start on the last bit."""
STOPPED_EARLY = {("Car", 1, 2): {117, 200, 210}, ("Car", 2, 2): {63, 76, 168, 183, 185, 189, 190, 237}}
NEARLY_PARALLEL = {("Car", 2, 2): set(range(218, 237))}
OTHER = {
    ("Point", 2, 2): {207, 208, 215, 216, 217, 218, 219, 221, 222, 226, 227},
    ("Car", 1, 2): {97, 98, 100, 101},
    ("Car", 2, 2): {
        99, 101, 114, 115, 120, 123, 139, 142, 145, 147, 148, 149, 150, 151, 153, 155, 157, 158, 159, 160,
        161, 162, 164, 165, 166, 167, 168, 169, 171, 172, 173, 174, 175, 176, 177, 179, 180, 181, 182, 183,
        184, 185, 187, 189, 190, 191, 192, 193, 194, 198, 199, 200, 201, 202, 203, 204, 205, 212, 213, 214,
        215, 216, 217, 246, 247, 248, 249, 250, 252, 253, 254, 260, 261, 266, 267, 268, 269, 274, 293, 294,
    },
}  # fmt: skip
"""Two boxes touch elsewhere, from MuJoCo 3.12 on."""
if not OTHER_CORNERS:
    OTHER.clear()
ROBOTS = pytest.mark.parametrize("robot", ["Point", "Car"])


def assert_within(errors, robot, kind):
    for name, limit in zip(MEASURED, LIMITS[robot, kind], strict=True):
        error = max((getattr(e, name) for e in errors), default=0.0)
        assert error <= limit, f"{name}: {error:.3g} > {limit:.3g}"


def touching(env):
    """Whether the point's box and a vase are in contact now; whether the car or another vase is with a vase."""
    pairs, model = env.data.contact.geom, env.model
    vase = (model.geom_bodyid >= model.body("vase0").id)[pairs].any(axis=1)
    if env.robot.name == "point":
        return bool((vase & (pairs == model.geom("pointarrow").id).any(axis=1)).any())
    return bool((vase & ~(pairs == model.geom("floor").id).any(axis=1)).any())


@ROBOTS
@pytest.mark.parametrize(("level", "episode"), EPISODES)
def test_every_recorded_step(monkeypatch, robot, level, episode):
    env, key = gym.make(f"Safe{robot}Goal{level}-v0").unwrapped, (robot, level, episode)
    errors = replay(env, Recording.load(level, episode, robot.lower()), monkeypatch, touching)
    early, other, singular = (steps.get(key, set()) for steps in (STOPPED_EARLY, OTHER, SINGULAR))
    free = {t: e for t, e in enumerate(errors) if not e.touched and t not in singular}
    agree = [e for t, e in free.items() if t not in early]
    fewest = {("Car", 1, 2): 220, ("Car", 2, 1): 299, ("Car", 2, 2): 100}
    assert len(agree) >= fewest.get(key, 300 if level == 1 else 270)
    assert_within(agree, robot, "agree")
    left_out = other
    if robot == "Car":
        assert_within(free.values(), robot, "stopped")
        left_out = other | singular  # the start that hangs on its last bit is beyond all bounds
    assert_within([e for t, e in enumerate(errors) if t not in left_out], robot, "touched")
    assert_within([errors[t] for t in other], robot, "corners")


@pytest.mark.parametrize(
    ("robot", "level", "episode"), [("Point", 2, 1), ("Point", 2, 2), ("Car", 1, 2), ("Car", 2, 2)]
)
def test_other_contacts_explain_the_steps_at_a_vase(monkeypatch, robot, level, episode):
    """With 2.3.3's contacts and penetration put back, these steps agree as well as all others."""
    env, key = gym.make(f"Safe{robot}Goal{level}-v0").unwrapped, (robot, level, episode)
    if robot == "Car":
        for name in ("mjDSBL_NATIVECCD", "mjDSBL_MULTICCD"):  # the latter is a flag to enable, up to 3.3
            if hasattr(mujoco.mjtDisableBit, name):
                env.model.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, name))
    monkeypatch.setattr(mujoco, "mj_forward", forward_as_2_3_3)
    errors = replay(env, Recording.load(level, episode, robot.lower()), monkeypatch, touching, step_as_2_3_3)
    touched = {t: e for t, e in enumerate(errors) if e.touched}
    assert len(touched) > (70 if robot == "Car" else 24)
    early, parallel, other, singular = (
        steps.get(key, set()) for steps in (STOPPED_EARLY, NEARLY_PARALLEL, OTHER, SINGULAR)
    )
    if HALVES_ITSELF and key == ("Car", 2, 2):
        early = early | {99, 165, 172}
    left_out = parallel | other | singular
    assert_within([e for t, e in touched.items() if t not in left_out | early], robot, "agree")
    if robot == "Car":
        assert_within([e for t, e in touched.items() if t not in left_out], robot, "stopped")
        assert_within([touched[t] for t in other], robot, "corners")
    for t in parallel & set(touched):
        assert touched[t].velocity < 0.5
        assert touched[t].sensors < (4e-3 if OTHER_CORNERS else 1e-4)  # the car's own
