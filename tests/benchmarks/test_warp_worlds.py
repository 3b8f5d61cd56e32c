"""The decision as a kernel of Warp, on the CPU: Numba's machine code is its oracle, and so is the filtered env."""

import numpy as np
import pytest

wp = pytest.importorskip("warp", reason="NVIDIA Warp is not installed: pip install '.[warp]'")
pytest.importorskip("mujoco_warp", reason="MuJoCo Warp is not installed: pip install '.[warp]'")

from benchmarks import warp_worlds  # noqa: E402
from benchmarks.drivers import DRIVERS  # noqa: E402
from safe_wrappers.control.backup import drive_decision as among  # noqa: E402


@pytest.mark.parametrize("uncertainty", [0.0, 0.2])
def test_every_stage_and_control_is_numbas(uncertainty):
    shared, states = (
        warp_worlds.scene(warp_worlds.sample(uncertainty=uncertainty)),
        warp_worlds.random_states(1500),
    )
    kernel = warp_worlds.WorldFilter(shared, 1500, 8)
    found = warp_worlds.agreement(shared, states, kernel)
    assert found.active > 100
    assert found.other_stage == 0
    assert found.largest < 1e-7  # the rounding to 32 bits
    assert found.short_m == 0.0
    assert {among.ROWS, among.CANDIDATE, among.BLEND, among.UNRESOLVED} <= set(kernel.stages.numpy())


def test_with_numbers_of_32_bits_only_borderline_stages_differ():
    shared, states = warp_worlds.scene(warp_worlds.sample()), warp_worlds.random_states(1500, seed=1)
    found = warp_worlds.agreement(shared, states, warp_worlds.WorldFilter(shared, 1500, 8, "float32"))
    assert found.active > 100
    assert found.other_stage == found.borderline
    assert found.typical < 1e-4
    assert found.short_m <= warp_worlds.MARGIN_32_M


def test_in_the_closed_loop_it_executes_what_the_env_does_and_keeps_to_its_side():
    env = warp_worlds.sample(margin=0.046)  # with protect's own 0.25 m to keep: exact in 32 bits
    raw, shared = env.unwrapped, warp_worlds.scene(env)
    raw._hazards[:] = raw._hazards.astype(np.float32)
    act = DRIVERS["hazard-seeking"](raw, np.random.default_rng(0))
    discs = np.column_stack([raw.hazard_positions, np.full(8, shared.room)])[None]
    kernel = warp_worlds.WorldFilter(shared, 1, 8)
    ctrl, changed, sides = wp.zeros((1, 2), dtype=wp.float32, device="cpu"), 0, set()
    for _ in range(900):
        qpos, qvel = (part.astype(np.float32).astype(float) for part in (raw.data.qpos, raw.data.qvel))
        raw.set_state(qpos, qvel)
        action = np.asarray(act()).astype(np.float32)
        given = [qpos[None, :3], qvel[None, :3], discs, action[None]]
        kernel.launch(*(wp.array(part, dtype=wp.float32, device="cpu") for part in given), ctrl)
        executed = env.step(action.astype(env.action_space.dtype))[4]["executed_action"]
        np.testing.assert_allclose(ctrl.numpy()[0], executed, atol=1e-7)
        changed += int(kernel.stages.numpy()[0] != among.PROPOSAL)
        side = float(kernel.sides.numpy()[0])
        kept = env.filter.bound[0].executed(executed)
        assert (side, kernel.kept.numpy()[0]) == (kept.side, kept.steps)
        sides.add(side)
    assert changed > 50 and len(sides) > 1


def test_a_world_that_is_no_number_coasts_and_leaves_the_others_alone():
    shared, states = warp_worlds.scene(warp_worlds.sample()), warp_worlds.random_states(40)
    kernel = warp_worlds.WorldFilter(shared, 40, 8)
    stages, controls = (part.copy() for part in kernel.decide(states))
    states.qpos[3, 0], states.qvel[5, 2], states.discs[7, 2, 1], states.proposals[9, 0] = (
        np.nan,
        np.inf,
        np.nan,
        -np.inf,
    )
    broken, broken_controls = kernel.decide(states)
    bad = np.array([3, 5, 7, 9])
    assert (broken[bad] == among.UNRESOLVED).all() and (broken_controls[bad] == 0.0).all()
    np.testing.assert_array_equal(np.delete(broken, bad), np.delete(stages, bad))
    np.testing.assert_array_equal(np.delete(broken_controls, bad, axis=0), np.delete(controls, bad, axis=0))
    inactive = np.flatnonzero(broken == among.PROPOSAL)
    assert (broken_controls[inactive] == states.proposals[inactive].astype(np.float32)).all()
