"""Authority of a remote operator is revoked in time: no breach, whatever the operator and the network do."""

import gymnasium as gym
import numpy as np
import pytest
from teleop_worlds import MARGIN, Energies, ceiling, channel, place

import safe_wrappers as sw
from safe_wrappers.envs.teleop_contact import CLAMP_Y, TOOL_RADIUS
from safe_wrappers.envs.teleop_operator import TeleopOperator

NETWORKS = {
    "ideal": (0.0, 0.0),
    "100 ms each way": (0.1, 0.1),
    "bursts of jitter": (sw.teleop.Link(0.01, 0.3), sw.teleop.Link(0.01, 0.2)),
    "half lost": (sw.teleop.Link(0.02, 0.02, 0.5), sw.teleop.Link(0.02, 0.02, 0.5)),
}


def never_stops(rng):
    while True:
        yield np.array([rng.uniform(-1, 1), 1.0])


def reverses_late(rng):
    while True:
        for action, steps in ((np.array([0.0, 1.0]), 150), (np.array([0.0, -1.0]), 40)):
            for _ in range(steps):
                yield action


def hectic(rng):
    while True:
        action = rng.choice([-1.0, 1.0], 2)
        for _ in range(int(rng.integers(1, 200))):
            yield action


DRIVERS = {"never stops": never_stops, "reverses late": reverses_late, "hectic": hectic}


def drive(env, driver, steps, seed=0, **start):
    rng = np.random.default_rng(seed)
    place(env, seed=seed, **start)
    least, revoked, infos = np.inf, 0, None
    for _, action in zip(range(steps), driver(rng), strict=False):
        infos = env.step(action)[4]
        least = min(least, env.unwrapped.clearance)
        revoked += infos["teleop/revoked"]
    return least, revoked


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("driver", DRIVERS)
def test_the_margin_is_kept_against_operators_and_networks(network, driver):
    up, down = NETWORKS[network]
    # No human and no video to wait for: only what the network and the brake themselves need is left.
    env = channel(up, down, **ceiling(human_s=0.0, video_s=0.0, longest_s=10.0))
    least, revoked = drive(env, DRIVERS[driver], 700, tool=(0.0, 0.12), velocity=(0.0, 0.3))
    assert least >= MARGIN - 1e-6
    assert revoked > 0


def test_without_a_ceiling_the_same_operators_breach():
    for driver in (never_stops, reverses_late):
        assert drive(channel(0.02, 0.02), driver, 700, tool=(0.0, 0.12))[0] < 0.0


def test_a_brake_that_is_weaker_than_declared_is_found_out():
    # Three times the deceleration that there is: the margin does not hold.
    env = channel(**ceiling(braking=75.0, human_s=0.0, video_s=0.0, longest_s=10.0))
    assert drive(env, never_stops, 400, tool=(0.0, 0.0))[0] < 0.5 * MARGIN


@pytest.mark.slow
def test_an_operator_who_looks_away_is_stopped_and_one_who_looks_is_not_disturbed():
    for stops in (True, False):
        env = channel(0.05, 0.05, impedance=40.0, **ceiling())
        energies, operator = Energies(env), TeleopOperator(1, stops=stops)
        observation, _ = place(env, (0.18, 0.12), seed=1)
        revoked, least = 0, np.inf
        for _ in range(3000):
            observation, *_, info = energies.step(operator.act(observation))
            revoked += info["teleop/revoked"]
            least = min(least, info["clearance"])
        # Both invariants in one run: clearance and energy.
        assert least > MARGIN and energies.worst < 1e-12
        if stops:
            assert info["swept"] > 0.06 and revoked < 400
        else:
            assert revoked > 50


def test_authority_is_revoked_at_the_ceiling_and_comes_back_below_it_with_a_new_command():
    env = channel(0.03, 0.02, **ceiling(human_s=0.2, video_s=0.05, longest_s=5.0))
    place(env, (0.0, -0.2))
    infos, ceilings = [], []
    for _ in range(1200):
        ceilings.append(env._ceiling_s)  # of the state that the step is decided in
        infos.append(env.step(np.array([0.0, 0.5]))[4])
    flags = np.array([i["teleop/revoked"] for i in infos])
    first = int(np.flatnonzero(flags)[0])
    assert infos[first]["teleop/round_trip_s"] > ceilings[first]
    assert all(i["teleop/round_trip_s"] <= c + 1e-9 for i, c in zip(infos[:first], ceilings, strict=False))
    back = first + int(np.flatnonzero(~flags[first:])[0])
    # At rest the ceiling is high at once; the command needs an image from after the revocation: a round trip.
    assert back - first == pytest.approx(50, abs=1)
    assert infos[back]["teleop/round_trip_s"] <= 0.8 * ceilings[back]
    for i in infos[first:back]:
        assert i["executed_action"][1] <= 0.0 or i["clearance"] < 0.3


def test_between_release_and_ceiling_authority_stays_where_it_is():
    # A clearance that a test can move, a machine that approaches at 1 m/s for ever.
    reading = {"clearance": 2.0}
    budget = sw.StoppingBudget(lambda env: (reading["clearance"], 1.0), braking=1e6, acceleration=0.0)
    env = channel(0.05, 0.05, budget=budget, video_s=0.0, human_s=0.0, longest_s=9.0, fallback="zero")
    place(env)

    def revoked(clearance, steps=150):
        reading["clearance"] = clearance
        return [env.step(np.zeros(2))[4]["teleop/revoked"] for _ in range(steps)][-1]

    assert not revoked(2.0)
    assert not revoked(0.11)  # a round trip of 0.1 s is still below 0.109
    assert revoked(0.10)
    assert revoked(0.11) and revoked(0.12)  # 0.8 of them is not
    assert not revoked(0.13)


def test_an_operator_who_goes_silent_loses_authority_at_rest_too():
    env = channel(**ceiling(longest_s=0.2))
    place(env)
    for _ in range(50):
        env.step(np.zeros(2))
    flags = []
    for _ in range(300):
        env.set_observation_time(None)
        flags.append(env.step(np.zeros(2))[4]["teleop/revoked"])
    assert not any(flags[:198]) and all(flags[202:])
    assert not env.step(np.zeros(2))[4]["teleop/revoked"]


def test_next_to_the_clamp_the_operator_may_still_back_off():
    env = channel(**ceiling(human_s=0.0, video_s=0.0))
    place(env, (0.0, 0.22))
    for _ in range(1200):
        info = env.step(np.array([0.0, 1.0]))[4]
    assert MARGIN - 1e-6 < info["clearance"] < 1.2 * MARGIN and info["teleop/revoked"]
    for _ in range(200):
        info = env.step(np.array([0.0, -0.3]))[4]
    assert info["clearance"] > 0.03 and not info["teleop/revoked"]


def test_an_arm_that_is_far_from_the_task_is_watched_as_well():
    # A cart on a rail, 40 ms a step, whose operator drives at its end.
    rail = sw.constraints.Clearance(
        [sw.constraints.Plane([-0.9], [1]), sw.constraints.Plane([0.9], [-1])], bodies=["cart"], braking=8.0
    )
    watched = {"budget": sw.StoppingBudget(rail, acceleration=30.0), "human_s": 0.1, "video_s": 0.0}
    for wanted in (watched, {}):
        env = sw.TeleopChannel(gym.make("InvertedPendulum-v5"), 0.04, 0.04, **wanted)
        env.reset(seed=0)
        farthest = 0.0
        for _ in range(120):
            env.step(np.array([1.5], np.float32))
            farthest = max(farthest, env.unwrapped.data.qpos[0])
        assert (farthest < 0.9) == bool(wanted)


def test_what_is_judged_and_executed_is_clipped_to_the_space_and_counted():
    loud, quiet = np.array([1e9, -0.5], np.float32), np.array([0.3, -0.5], np.float32)
    for watched in (ceiling(), {}):
        env = channel(**watched)
        place(env)
        info = env.step(loud)[4]
        assert info["executed_action"].tolist() == [1.0, -0.5] and info["action/clipped"] == 1e9 - 1.0
        info = env.step(quiet)[4]
        assert (
            np.array_equal(info["executed_action"], quiet.astype(np.float64))
            and info["action/clipped"] == 0.0
        )


ROOM = CLAMP_Y - TOOL_RADIUS
HOLD = 0.001


@pytest.mark.parametrize("speed", [0.05, 0.2, 1.0])
@pytest.mark.parametrize("y", [-0.4, 0.0, 0.2])
def test_the_ceiling_is_the_appendixs_formula_less_one_step(speed, y):
    env = channel(**ceiling(video_s=0.1, human_s=0.2, delays_s=0.01, margin=0.003, longest_s=100.0))
    place(env, (0.0, y), (0.0, speed))
    by_hand = (ROOM - y - 0.003 - speed**2 / 48.0) / speed - (0.1 + 0.2 + 0.01) - HOLD
    assert env._ceiling_s == pytest.approx(by_hand, abs=1e-9)


def test_far_away_any_command_may_be_executed_and_close_by_only_one_that_can_be_stopped():
    env = channel(**ceiling())
    place(env)
    possible = env._budget.can_stop_after
    assert possible(np.array([0.0, 1.0]), HOLD)
    place(env, (0.0, ROOM - 0.001 - 0.00002))  # 20 micrometres before its margin
    assert not possible(np.array([0.0, 1.0]), HOLD)
    for away in (0.0, -0.2, -1.0):
        assert possible(np.array([0.5, away]), HOLD)
    place(env, (0.0, ROOM - 0.02), (0.0, 1.0))  # it needs 0.0208 + 0.001 m to stop
    assert not possible(np.array([0.0, 0.0]), HOLD)


def test_the_delay_of_the_brake_is_counted():
    for delays_s, possible in ((0.0, True), (0.02, False)):
        env = channel(**ceiling(delays_s=delays_s))
        place(env, (0.0, ROOM - 0.03), (0.0, 1.0))
        assert env._budget.can_stop_after(np.array([0.0, 0.0]), HOLD) == possible


@pytest.mark.parametrize("answer", [(np.nan, 0.1), (0.1, np.inf), (-np.inf, 0.0)])
def test_what_cannot_be_read_has_no_ceiling(answer):
    env = channel(budget=sw.StoppingBudget(lambda env: answer, braking=1.0, acceleration=1.0))
    place(env)
    assert not env._budget.readable and env._ceiling_s == -1.0
    assert not env._budget.can_stop_after(np.zeros(2), HOLD)
