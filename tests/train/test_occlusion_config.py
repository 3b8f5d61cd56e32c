"""OcclusionPenalty in configs: read, refused by name, in its place in the stack, and in the runs' fingerprint."""

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError, UnknownNameError
from safe_wrappers.train.config import EnvConfig, FilterConfig, parse_experiment
from safe_wrappers.train.run.stack import make_stack

pytestmark = pytest.mark.filterwarnings("ignore::safe_wrappers.UnsafeStateWarning")
OCCLUSION = {
    "tracks": [{"bodies": "car*", "acceleration_noise": [0.0225, 0], "start_position_std": [0.3, 0]}],
    "sensor": {"camera": "eye", "range_m": 6},
    "tolerance": 0.5,
    "weight": 0.1,
}
TASK = "OccludedCrossing-v0"


def parsed(env, **arms):
    common = {"name": "x", "algorithm": "PPO", "total_steps": 10, "seeds": [0], "output": "runs"}
    return parse_experiment({**common, "env": env, "arms": arms or {"a": {"filter": "none"}}})


def test_it_is_read_and_changes_the_fingerprint_only_where_it_is():
    env = {"id": TASK, "occlusion": OCCLUSION}
    more = {"id": TASK, "occlusion": OCCLUSION | {"weight": 0.2}}
    arms = parsed(
        env, a={"filter": "none"}, b={"filter": "none", "env": more}, c={"filter": "none", "env": TASK}
    ).arms
    assert [arm.env.occlusion and arm.env.occlusion["weight"] for arm in arms] == [0.1, 0.2, None]
    prints = [arm.fingerprint()["env"] for arm in arms]
    assert prints[0]["occlusion"] == OCCLUSION and "occlusion" not in prints[2]
    assert prints[0] != prints[1]


@pytest.mark.parametrize(
    ("occlusion", "error", "words"),
    [
        ({"tolerence": 1}, UnknownNameError, "Did you mean 'tolerance'"),
        ({"env": 1}, UnknownNameError, "env.occlusion"),
        (["car"], ConfigurationError, "env.occlusion"),
    ],
)
def test_what_cannot_be_is_refused_by_name(occlusion, error, words):
    with pytest.raises(error, match=words):
        parsed({"id": TASK, "occlusion": occlusion})


def test_what_is_missing_is_said_when_the_stack_is_made():
    with pytest.raises(ConfigurationError, match=r"env.occlusion.*sensor"):
        make_stack(EnvConfig(TASK, {}, {}, {"tracks": OCCLUSION["tracks"], "tolerance": 1.0}), FilterConfig())
    with pytest.raises(ConfigurationError, match=r"env.occlusion.*tracks"):
        make_stack(EnvConfig(TASK, {}, {}, {}), FilterConfig())


@pytest.mark.slow
def test_the_stack_has_it_inside_the_filter_and_the_recorder_counts_what_it_tells():
    stack = make_stack(EnvConfig(TASK, {}, {}, OCCLUSION), FilterConfig(protect={"cars": "estimated"}))
    kinds, inner = [], stack.env
    while isinstance(inner, gym.Wrapper):
        kinds.append(type(inner))
        inner = inner.env
    assert kinds[:3] == [sw.RecordInterventions, sw.CBFActionFilter, sw.OcclusionPenalty]
    stack.reset(seed=0)
    total, taken, info, done = 0.0, 0.0, {}, False
    while not done:
        _, reward, _, done, info = stack.step(np.array([0.0, 1.0, 0.2], np.float32))
        total, taken = total + reward, taken + info["occlusion/penalty"]
    assert info["interventions"]["return"] == pytest.approx(total + taken)
    assert info["episode"]["r"] == pytest.approx(total, abs=1e-5)  # Monitor's holds the penalty
    assert info["interventions"]["return"] > total and "collisions" in info["interventions"]
    assert 0.0 < info["interventions"]["seen"] < 1.0
