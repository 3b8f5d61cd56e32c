"""One-step equivalence of the car with Safety-Gymnasium's: every step of four recorded episodes, from its state.

The recordings are of Safety-Gymnasium 1.2 on MuJoCo 2.3.3; ours runs on a MuJoCo of today. Measured with
3.11, worst absolute errors over the 1200 steps (m, rad, m/s, rad/s, m/s^2):

==========================================  =====  ========  ========  =======  =======  =======  ====
steps                                       count  position  velocity  sensors  lidar    reward   cost
==========================================  =====  ========  ========  =======  =======  =======  ====
no vase touched                             919    1.0e-9    9.6e-8    4.4e-12  9.4e-10  8.9e-16  0
no vase touched, 2.3.3 stopped early        6      3.4e-6    6.3e-4    4.6e-7   1.0e-6   3.8e-11  0
a vase touched                              274    1.4e-2    2.4       6.2e-2   2.5e-2   2.1e-5   0
the same with 2.3.3's contacts              251    1.1e-9    1.3e-7    4.8e-10  1.8e-9   6.7e-13  0
the same, 2.3.3 stopped early               5      1.1e-6    3.6e-4    3.8e-6   8.3e-7   6.1e-11  0
the same, two vases against each other      18     5.2e-4    1.5e-1    2.5e-5   4.9e-4   7.3e-9   0
one singular start, below                   1      4.0e-2    5.6       6.0      1.0e-2   2.0e-4   0
==========================================  =====  ========  ========  =======  =======  =======  ====

What is left, and why:

* No vase touched: vases slower than 1e-7 m/s are asleep here, and creep on there. With sleeping off, the velocities
  agree to 1e-12.
* 2.3.3 stopped early: its solver, given a tolerance of 1e-12 instead of 1e-8, gives what we give (tried by
  hand, on the vases' contacts with the floor).
* A vase touched: 2.3.3 reported one contact where later versions report up to four (a wheel's rim on a box),
  and half of the penetration of two boxes (bumper on vase, vase on vase; see `mujoco_2_3_3`). With both put
  back these steps agree as all others do. We keep today's contacts: a pushed vase moves differently, the car hardly
  (a vase has 0.03 % of its mass), the cost not at all.
* MuJoCo 3.3 still halves penetrations itself; level 2, episode 2, steps 99, 165 and 172 are up to 2e-7 m off there,
  not by its solver's tolerance (tried by hand), all others agree.
* From MuJoCo 3.12 on another algorithm finds where two boxes touch. In 84 of the steps that touch a vase it reports
  other points than 2.3.3, which moves vases by up to 16 mm a step, and the car's accelerometer by 10 m/s^2 in one of
  them. The cost is the same in every step.
* Two vases against each other, level 2, episode 2, steps 218 to 236: their edges and faces meet nearly parallel,
  and the rule by which 2.3.3 halved a penetration is not ours to guess there.
* A singular start, level 2, episode 1, step 0: all three wheels stand on the floor at a distance of exactly 0.
  On 2.3.3, too, the result changes by 5 rad/s when the car is lifted by 1e-16 m (tried by hand).

(Our own MJCF run on 2.3.3 repeats all the other 1199 steps to 3e-11; tried by hand.)
"""

import mujoco
import numpy as np
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

AGREE = {"position": 5e-9, "velocity": 5e-7, "sensors": 2e-9, "lidar": 5e-9, "reward": 1e-12, "cost": 0.0}
"""Equivalence: some three times the worst measured."""
STOPPED = {"position": 1e-5, "velocity": 2e-3, "sensors": 1e-5, "lidar": 3e-6, "reward": 2e-10, "cost": 0.0}
"""Bounds where 2.3.3's solver stopped early."""
TOUCHED = {"position": 3e-2, "velocity": 5.0, "sensors": 0.2, "lidar": 6e-2, "reward": 6e-5, "cost": 0.0}
"""Bounds on what other contacts change in one step: for a vase, not for the car."""
CORNERS = {"position": 5e-2, "velocity": 6.0, "sensors": 30.0, "lidar": 4e-2, "reward": 4e-4, "cost": 0.0}
"""Bounds on what other contact points of two boxes change: some three times the worst measured with 4.0."""
SINGULAR = (2, 1, 0)
"""Level, episode and step that hangs on the last bit of the start."""
STOPPED_EARLY = {(1, 2): {117, 200, 210}, (2, 2): {63, 76, 168, 183, 185, 189, 190, 237}}
NEARLY_PARALLEL = {(2, 2): set(range(218, 237))}
OTHER = {
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
    OTHER.clear()


def worst(errors):
    """Largest error per quantity over steps; zeros for no steps."""
    return {name: max((getattr(e, name) for e in errors), default=0.0) for name in AGREE}


def assert_within(errors, limits):
    for name, error in worst(errors).items():
        assert error <= limits[name], f"{name}: {error:.3g} > {limits[name]:.3g}"


def vase_touched(env):
    """Whether the car or another vase is in contact with a vase now."""
    vases = env.model.geom_bodyid >= env.model.body("vase0").id
    pairs = env.data.contact.geom
    on_floor = (pairs == env.model.geom("floor").id).any(axis=1)
    return bool((vases[pairs].any(axis=1) & ~on_floor).any())


@pytest.mark.parametrize(("level", "episode"), EPISODES)
def test_every_recorded_step(make_car, monkeypatch, level, episode):
    recording = Recording.load(level, episode, "car")
    errors = replay(make_car(level), recording, monkeypatch, vase_touched)
    assert len(errors) == 300
    assert all(e.goal_met for e in errors)
    assert not any(e.over for e in errors)
    regular = [(t, e) for t, e in enumerate(errors) if (level, episode, t) != SINGULAR]
    early = STOPPED_EARLY.get((level, episode), set())
    free = [e for t, e in regular if not e.touched and t not in early]
    assert len(free) == {(1, 1): 300, (1, 2): 220, (2, 1): 299, (2, 2): 100}[level, episode]
    assert_within(free, AGREE)
    assert_within([e for _, e in regular if not e.touched], STOPPED)
    other = OTHER.get((level, episode), set())
    assert_within([e for t, e in regular if t not in other], TOUCHED)
    assert_within([errors[t] for t in other], CORNERS)


@pytest.mark.parametrize("level", [1, 2])
def test_other_contacts_explain_the_steps_that_touch_a_vase(make_car, monkeypatch, level):
    """With 2.3.3's contacts put back, these steps agree as well as all others."""
    env = make_car(level)
    for name in ("mjDSBL_NATIVECCD", "mjDSBL_MULTICCD"):  # the latter is a flag to enable, up to 3.3
        if hasattr(mujoco.mjtDisableBit, name):
            env.model.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, name))
    monkeypatch.setattr(mujoco, "mj_forward", forward_as_2_3_3)
    recording = Recording.load(level, 2, "car")
    errors = replay(env, recording, monkeypatch, vase_touched, step_as_2_3_3)
    touched = {t: e for t, e in enumerate(errors) if e.touched}
    assert len(touched) > 70
    early, parallel = STOPPED_EARLY[level, 2], NEARLY_PARALLEL.get((level, 2), set())
    other = OTHER.get((level, 2), set())
    if HALVES_ITSELF and level == 2:
        early = early | {99, 165, 172}
    assert_within([e for t, e in touched.items() if t not in early | parallel | other], AGREE)
    assert_within([e for t, e in touched.items() if t not in parallel | other], STOPPED)
    assert_within([touched[t] for t in other], CORNERS)
    for t in parallel & set(touched):
        assert touched[t].velocity < 0.5
        assert touched[t].sensors < (4e-3 if OTHER_CORNERS else 1e-4)  # the car's own


def test_car_alone_agrees_to_rounding(make_car):
    """Where only the car moves, the dynamics are the same sums in another order."""
    recording = Recording.load(1, 1, "car")
    env = make_car(1)
    layout = {"goal": recording.goal[0], "hazards": recording.hazards, "vases": [[50.0, 50.0]]}
    env.reset(seed=0, options={"layout": layout})
    at_rest = env.data.qpos.copy()
    for t in range(len(recording)):
        at_rest[:13] = recording.qpos[t, :13]
        env.set_state(at_rest, np.r_[recording.qvel[t, :11], np.zeros(6)])
        env.data.qacc_warmstart[:] = recording.warmstart[t]
        observation, *_ = env.step(recording.action[t])
        np.testing.assert_allclose(env.data.qpos[:13], recording.qpos[t + 1, :13], rtol=0, atol=1e-12)
        np.testing.assert_allclose(env.data.qvel[:11], recording.qvel[t + 1, :11], rtol=0, atol=1e-10)
        np.testing.assert_allclose(observation[:24], recording.obs[t + 1, :24], rtol=0, atol=1e-10)
