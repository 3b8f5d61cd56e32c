"""macro_info: what is left of many infos, by hand, and through ChunkHandover with the layers inside."""

import gymnasium as gym
import numpy as np
import pytest
from chunk_worlds import Line

import safe_wrappers as sw
from safe_wrappers import info as keys
from safe_wrappers.wrappers.chunk_handover import macro_info
from safe_wrappers.wrappers.faults import DroppedRefreshes

REFUSED = ([True, False], [False, False], [False, False])
INFOS = [
    {
        "cost": cost,
        "cost_substep": 2 * cost,
        **dict.fromkeys(keys.CBF_BOOLS, flag),
        **dict.fromkeys(
            (keys.LEASE_EXPIRED, keys.LEASE_REFUSED, keys.LEASE_BRAKING, keys.FAULT_ACTIVE), flag
        ),
        keys.CBF_REFUSED: np.array(refused),
        keys.SLIP_LIMITED: np.array(refused),
        keys.SLIP_RATIO: np.array([0.1 * i, 0.0]),
        keys.SPIN_OUT: float(flag),
        keys.CBF_CORRECTION: correction,
        keys.CBF_CLIPPED: correction / 2,
        keys.CBF_MARGIN: margin,
        keys.LEASE_REMAINING_S: 0.1 * i,
        keys.LEASE_CLIPPED: correction / 4,
        keys.TELEOP_CLIPPED: correction / 8,
        keys.EXECUTED_ACTION: np.array([i], np.float32),
        keys.ADAPTION_PENALTY: 0.5 * i,
        keys.ADAPTION_TASK_REWARD: 1.0 * i,
        keys.COLLISIONS: i,
        keys.OCCLUSION_PENALTY: 0.25 * i,
        keys.OCCLUSION_TASK_REWARD: 2.0 * i,
        keys.OCCLUSION_EXPIRED: np.array(refused),
        keys.OCCLUSION_VISIBLE: np.array(refused),
        keys.OCCLUSION_SIGMA: np.array([0.3 - 0.1 * i, 0.1]),
        "interventions/cost": 10.0 * i,
        "own": f"step {i}",
    }
    for i, (cost, flag, refused, correction, margin) in enumerate(
        zip((1.0, 0.0, 0.5), (False, True, False), REFUSED, (0.2, 0.7, 0.0), (0.3, -0.1, 0.2), strict=True)
    )
]


def test_sums_flags_extremes_and_the_last():
    found = macro_info([dict(info) for info in INFOS])
    assert found.keys() == INFOS[0].keys()
    assert found["cost"] == 1.5 and found["cost_substep"] == 3.0
    for name in (
        *keys.CBF_BOOLS,
        keys.LEASE_EXPIRED,
        keys.LEASE_REFUSED,
        keys.LEASE_BRAKING,
        keys.FAULT_ACTIVE,
    ):
        assert found[name] is True, name
    assert found[keys.CBF_REFUSED].tolist() == [True, False] and found[keys.CBF_REFUSED].dtype == bool
    assert found[keys.SLIP_LIMITED].tolist() == [True, False] and found[keys.SLIP_LIMITED].dtype == bool
    assert found[keys.SLIP_RATIO].tolist() == [0.2, 0.0]
    assert found[keys.SPIN_OUT] == 1.0 and type(found[keys.SPIN_OUT]) is float
    assert found[keys.CBF_CORRECTION] == 0.7 and found[keys.CBF_CLIPPED] == 0.35
    assert found[keys.LEASE_CLIPPED] == 0.175 and found[keys.TELEOP_CLIPPED] == 0.0875
    assert found[keys.CBF_MARGIN] == -0.1
    assert found[keys.ADAPTION_PENALTY] == 1.5 and found[keys.ADAPTION_TASK_REWARD] == 3.0
    assert found[keys.COLLISIONS] == 3
    assert found[keys.OCCLUSION_PENALTY] == 0.75 and found[keys.OCCLUSION_TASK_REWARD] == 6.0
    assert found[keys.OCCLUSION_EXPIRED].tolist() == [True, False]
    assert found[keys.OCCLUSION_VISIBLE].tolist() == [False, False], "what is seen now, not what was"
    assert found[keys.OCCLUSION_SIGMA] == pytest.approx([0.1, 0.1])
    assert found[keys.LEASE_REMAINING_S] == 0.2 and found["own"] == "step 2"
    assert found["interventions/cost"] == 20.0 and found[keys.EXECUTED_ACTION].tolist() == [2.0]


def test_types_are_those_of_one_step():
    found = macro_info([dict(info) for info in INFOS])
    for name, value in INFOS[0].items():
        assert type(found[name]) is type(value), name


@pytest.mark.parametrize(
    "kind", [float, np.float64, np.float32, int, lambda x: np.array(x), lambda x: np.array([x])]
)
def test_a_cost_of_any_number_type_keeps_it(kind):
    infos = [{"cost": kind(x)} for x in (1, 0, 2)]
    found = macro_info(infos)["cost"]
    assert type(found) is type(kind(0)) and np.asarray(found).dtype == np.asarray(kind(0)).dtype
    assert np.shape(found) == np.shape(kind(0)) and float(np.ravel(found)[0]) == 3.0


@pytest.mark.parametrize("at", [[0], [1], [2], [0, 2], []])
def test_a_cost_that_is_only_there_when_there_is_one_is_not_lost(at):
    infos = [{"cost": 1.0} if i in at else {} for i in range(3)]
    assert macro_info(infos).get("cost", 0.0) == len(at)


def test_one_info_is_itself():
    assert macro_info([dict(INFOS[1])]) == INFOS[1]


def test_an_env_that_reuses_its_info_dict():
    shared = {}

    def infos(line):
        shared["cost"] = float(line.steps)
        return shared

    env = sw.ChunkHandover(Line(infos=infos), 4, 4, rate_limit=5.0, fallback="zero")
    env.reset(seed=0)
    assert env.step(np.zeros((4, 1), np.float32))[4]["cost"] == 1 + 2 + 3 + 4
    assert shared == {"cost": 4.0}, "what is the env's own is left alone"


class Recorder(gym.Wrapper):
    """Every control step's reward and info."""

    def reset(self, **how):
        self.seen = []
        return self.env.reset(**how)

    def step(self, action):
        found = self.env.step(action)
        self.seen.append((found[1], dict(found[4])))
        return found


def bang(env, steps, seed=0):
    """Full torque this way and that at every control step: the filter has to act."""
    rng = np.random.default_rng(seed)
    for _ in range(steps):
        yield (env.action_space.high * rng.choice([-1.0, 1.0], env.action_space.shape)).astype(np.float32)


def test_no_intervention_of_the_filter_is_lost_and_penalties_explain_the_reward():
    env = sw.CBFActionFilter(gym.make("Reacher-v5"), [sw.constraints.JointSpeedLimit(6.0)])
    recorder = Recorder(sw.AdaptionPenalty(env, penalty=0.5, per_correction=0.25))
    env = sw.ChunkHandover(recorder, 6, 5, rate_limit=1000.0)
    env.reset(seed=0)
    intervened = []
    for chunk in bang(env, 10):
        _, reward, _, _, info = env.step(chunk)
        last = recorder.seen[-5:]
        intervened.append([i["cbf/intervened"] for _, i in last])
        assert info["cbf/intervened"] == any(intervened[-1])
        assert info["cbf/correction"] == max(i["cbf/correction"] for _, i in last)
        assert info["cbf/margin"] == min(i["cbf/margin"] for _, i in last)
        assert info["cbf/refused"].tolist() == [any(i["cbf/refused"][0] for _, i in last)]
        assert reward == pytest.approx(sum(r for r, _ in last))
        assert reward == pytest.approx(info["adaption/task_reward"] - info["adaption/penalty"])
    assert any(any(i) and not i[-1] for i in intervened), "a last step alone would have lost some"


def test_no_braking_of_the_lease_and_no_fault_inside_is_lost():
    line = Line(low=-1.0, high=1.0)
    lease = sw.LeaseExpiry(
        line,
        sw.StoppingBudget(lambda env: ([1.0], [0.0]), braking=1.0, acceleration=1.0),
        max_lease_s=0.1,
        blend_time=0.0,
        fallback="zero",
    )
    recorder = Recorder(DroppedRefreshes(lease, share=0.3))
    env = sw.ChunkHandover(recorder, 8, 4, rate_limit=50.0, fallback="zero")
    env.reset(seed=0)
    for _ in range(10):
        info = env.step(np.full((8, 1), 0.5, np.float32))[4]
        last = [i for _, i in recorder.seen[-4:]]
        for name in ("lease/braking", "lease/expired", "lease/refused", "fault/active"):
            assert info[name] == any(i[name] for i in last), name
        assert info["lease/remaining_s"] == last[-1]["lease/remaining_s"]
    every = [i for _, i in recorder.seen]
    assert any(i["lease/braking"] for i in every) and any(i["fault/active"] for i in every)


def test_penalties_for_not_seeing_explain_a_chunk_s_reward_and_no_expiry_inside_is_lost():
    cars = [sw.occlusion.Track("car*", acceleration_noise=[0.2, 0.0])]
    seen = sw.OcclusionPenalty(gym.make("OccludedCrossing-v0"), cars, "eye", tolerance=0.5, weight=0.1)
    recorder = Recorder(seen)
    env = sw.ChunkHandover(recorder, 6, 5, rate_limit=1e6, fallback="zero")
    env.reset(seed=0)
    lost = 0
    for chunk in bang(env, 30):
        _, reward, _, _, info = env.step(chunk)
        last = [i for _, i in recorder.seen[-5:]]
        assert reward == pytest.approx(info["occlusion/task_reward"] - info["occlusion/penalty"])
        assert info["occlusion/penalty"] == pytest.approx(sum(i["occlusion/penalty"] for i in last))
        assert info["collisions"] == sum(i["collisions"] for i in last)
        expired = np.any([i["occlusion/expired"] for i in last], axis=0)
        assert info["occlusion/expired"].tolist() == expired.tolist()
        lost += int((expired & ~last[-1]["occlusion/expired"]).sum())
        assert info["occlusion/visible"].tolist() == last[-1]["occlusion/visible"].tolist()
    assert lost > 0, "a last step alone would have lost some"


def test_the_zero_moment_points_margin_is_of_steps_that_have_one():
    inside = {"balance/zmp_margin": 0.2, "balance/supported": 1.0}
    airborne = {"balance/zmp_margin": 0.0, "balance/supported": 0.0}
    assert macro_info([airborne, dict(inside)])["balance/zmp_margin"] == 0.2
