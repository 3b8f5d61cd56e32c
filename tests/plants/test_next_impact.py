"""NextImpact: pairs by MuJoCo's own collision detection, times and masses by differences of distances."""

import mujoco
import numpy as np
import pytest

from safe_wrappers.errors import UnsupportedEnvError
from safe_wrappers.plants.mujoco.contacts import Contacts
from safe_wrappers.plants.queries.next_impact import NextImpact, _velocities

ARM = """<mujoco><option timestep="0.005" gravity="0 0 0"/><worldbody>
<geom name="floor" type="plane" pos="0 0 -.6" euler="5 0 0" size="3 3 .1"/>
<geom name="post" type="cylinder" pos=".45 .3 0" size=".05 .3" margin=".01"/>
<geom name="painted" type="box" pos="0 0 .5" size=".3 .3 .1" contype="0" conaffinity="0"/>
<body name="upper"><joint name="a" axis="0 0 1"/><joint name="b" axis="0 1 0"/>
<geom name="bone" type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="1"/>
<body name="lower" pos=".3 0 0"><joint name="c" axis="0 .3 1" armature=".01"/>
<geom name="shin" type="capsule" fromto="0 0 0 .25 0 .05" size=".02" mass="1"/>
<body name="hand" pos=".25 0 .05"><geom name="hand" type="ellipsoid" size=".06 .03 .02" mass=".2"/>
<geom name="thumb" size=".02" pos="0 .05 0" contype="2" conaffinity="2" mass=".1"/></body></body></body>
<body name="ball" pos=".7 .1 .1"><freejoint/><geom name="ball" size=".05" mass=".6"/></body>
<body name="egg" pos="-.3 .5 .1"><freejoint/><geom name="egg" type="ellipsoid" size=".05 .08 .1" mass=".9"/></body>
</worldbody><contact><pair geom1="thumb" geom2="egg" margin=".02"/><exclude body1="lower" body2="egg"/></contact>
</mujoco>"""


def finder(model, bodies=None, against=None):
    return NextImpact(model, Contacts(model, bodies, against).watched)


def states(model, count):
    rng, data = np.random.default_rng(0), mujoco.MjData(model)
    for _ in range(count):
        mujoco.mj_resetData(model, data)
        data.qpos[:3] += rng.uniform(-1.2, 1.2, 3)
        for first in (3, 10):
            data.qpos[first : first + 3] += rng.uniform(-0.3, 0.3, 3)
            data.qpos[first + 3 : first + 7] = rng.normal(size=4)
        data.qvel[:] = rng.uniform(-2.0, 2.0, model.nv)
        mujoco.mj_normalizeQuat(model, data.qpos)
        mujoco.mj_forward(model, data)
        yield data


def pairs_of_mujoco():
    """What MuJoCo finds in contact with margins that reach everything."""
    far = mujoco.MjModel.from_xml_string(ARM)
    far.geom_margin[:], far.pair_margin[:] = 50.0, 50.0
    far.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
    data = mujoco.MjData(far)
    mujoco.mj_forward(far, data)
    return {tuple(sorted(contact.geom.tolist())) for contact in data.contact}


def ways(model, data, pairs, step=1e-6):
    """By pair: distance, how fast it shrinks, and how each degree of freedom shrinks it, by central differences."""

    def gaps(velocity, time):
        moved = mujoco.MjData(model)
        moved.qpos[:] = data.qpos
        mujoco.mj_integratePos(model, moved.qpos, velocity, time)
        mujoco.mj_kinematics(model, moved)
        return {pair: mujoco.mj_geomDistance(model, moved, *pair, 1e3, None) for pair in pairs}

    here, units = gaps(np.zeros(model.nv), 0.0), [*np.eye(model.nv), data.qvel.copy()]
    rows = [(gaps(unit, -step), gaps(unit, step)) for unit in units]
    return {p: (here[p], np.array([(b[p] - a[p]) / (2.0 * step) for b, a in rows])) for p in here}


def test_it_is_the_soonest_of_all_pairs_by_differences_of_their_distances():
    model = mujoco.MjModel.from_xml_string(ARM)
    near, hit, pairs = finder(model), set(), pairs_of_mujoco()
    for data in states(model, 12):
        impact = near.of(data)
        inertia = np.zeros((model.nv, model.nv))
        for column, unit in zip(inertia, np.eye(model.nv), strict=True):
            mujoco.mj_mulM(model, data, column, unit)
        soonest = np.inf, None, None, None
        for pair, (gap, rows) in ways(model, data, pairs).items():
            names = {model.geom(g).name for g in pair}
            touch = 0.02 if names == {"thumb", "egg"} else 0.01 if "post" in names else 0.0
            if gap > touch and rows[-1] > 1e-6:
                mass = 1.0 / (rows[:-1] @ np.linalg.solve(inertia, rows[:-1]))
                soonest = min(soonest, ((gap - touch) / rows[-1], pair, rows[-1], mass))
        time, pair, speed, mass = soonest
        assert impact.bodies == tuple(sorted(int(model.geom_bodyid[g]) for g in pair))
        assert impact.time_s == pytest.approx(time, rel=1e-4)
        assert impact.speed == pytest.approx(speed, rel=1e-4)
        assert impact.mass == pytest.approx(mass, rel=1e-4)
        hit.add(impact.bodies)
    assert len(hit) >= 4


def test_the_pairs_are_those_that_mujoco_lets_collide():
    near = finder(mujoco.MjModel.from_xml_string(ARM))
    found = [tuple(sorted(pair)) for pair in zip(near._first.tolist(), near._second.tolist(), strict=True)]
    assert set(found) == pairs_of_mujoco() and len(found) == len(set(found))


def test_no_pair_is_left_out_that_would_be_the_first():
    model, skipped = mujoco.MjModel.from_xml_string(ARM), 0
    near, all_of_them = finder(model), finder(model)
    whole = all_of_them._in_order
    all_of_them._in_order = lambda *motion: [(pair, 0.0) for pair, _ in whole(*motion)]
    for data in states(model, 300):
        data.qvel[[0, 1, 2, 6, 7, 8, 12, 13, 14]] *= 50.0  # it spins more than it moves
        impact = near.of(data)
        assert impact == all_of_them.of(data) or impact.time_s == np.inf
        order = near._in_order(*_velocities(model, near._data))
        skipped += sum(least_s > impact.time_s for _, least_s in order)
    assert skipped > 100


def test_only_watched_pairs_count_and_the_state_is_only_read():
    model = mujoco.MjModel.from_xml_string(ARM)
    chosen = finder(model, ["ball"], ["world", "hand"])
    allowed = {tuple(sorted((model.body("ball").id, model.body(n).id))) for n in ("world", "hand")}
    seen = set()
    for data in states(model, 30):
        before = data.qpos.tobytes(), data.xpos.tobytes(), data.qacc_warmstart.tobytes()
        impact = chosen.of(data)
        assert before == (data.qpos.tobytes(), data.xpos.tobytes(), data.qacc_warmstart.tobytes())
        assert (impact.bodies is None) == (impact.time_s == np.inf) == np.isnan(impact.mass)
        seen.add(impact.bodies)
    assert seen == allowed | {None}


def test_what_touches_or_stands_or_parts_has_no_next_impact():
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><geom type="plane" size="1 1 1"/><body name="ball" pos="0 0 1"><freejoint/>
        <geom size=".1"/></body></worldbody></mujoco>"""
    )
    data, near = mujoco.MjData(model), finder(model)
    for height, speed, time in (
        (1.0, 0.0, np.inf),
        (1.0, 2.0, np.inf),
        (1.0, -2.0, 0.45),
        (0.0999, -2.0, np.inf),
    ):
        data.qpos[2], data.qvel[2] = height, speed
        assert near.of(data).time_s == pytest.approx(time)
    data.qvel[2] = np.nan
    assert np.isnan(near.of(data).time_s) and near.of(data).bodies is None
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    data.qpos[2], data.qvel[2] = 1.0, -2.0
    assert finder(model).of(data).time_s == np.inf


def test_what_cannot_be_measured_is_refused_unless_it_is_not_watched():
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><asset><hfield name="h" nrow="2" ncol="2" size="1 1 1 1"/></asset><worldbody>
        <body name="hills"><geom type="hfield" hfield="h"/></body><geom type="plane" size="1 1 1" pos="0 0 -1"/>
        <body name="ball" pos="0 0 1"><freejoint/><geom size=".1"/></body></worldbody></mujoco>"""
    )
    with pytest.raises(UnsupportedEnvError, match="impacts of a height field \\(of 'hills'\\)"):
        finder(model)
    assert finder(model, ["ball"], ["world"]).of(mujoco.MjData(model)).time_s == np.inf
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><geom type="plane" size="1 1 1" pos="0 0 -1"/><flexcomp name="cloth" type="grid"
        count="3 3 1" spacing=".1 .1 .1" radius=".01" pos="0 0 1"/></worldbody></mujoco>"""
    )
    with pytest.raises(UnsupportedEnvError, match="flexible parts"):
        finder(model)
