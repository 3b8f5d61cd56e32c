from pathlib import Path

import pytest

from safe_wrappers.errors import ConfigurationError, UnknownNameError
from safe_wrappers.train.config import parse_experiment, read_config

CONFIGS = Path(__file__).parents[2] / "configs"
MINIMAL = {
    "name": "x",
    "env": "InvertedPendulum-v5",
    "algorithm": "PPO",
    "total_steps": 1000,
    "arms": {"unfiltered": {}},
    "seeds": [0],
}


def changed(**settings):
    return parse_experiment({**MINIMAL, **settings})


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yaml")), ids=lambda path: path.stem)
def test_every_config_of_the_repo_is_valid(path):
    experiment = parse_experiment(read_config(path))
    assert experiment.name == path.stem
    kinds = {arm.name: arm.filter.kind for arm in experiment.arms}
    assert "none" in kinds.values() or path.stem == "pointgoal1_learners"
    assert experiment.evaluation_filter.kind == "protect"


def test_an_evaluation_may_name_its_own_filter():
    arms = {"unfiltered": {"filter": "none"}}
    assert changed(arms=arms).evaluation_filter.kind == "none"
    on = changed(arms=arms, evaluation={"episodes": 1, "filter": {"protect": {"margin": 0.1}}})
    assert on.evaluation_filter.protect == {"margin": 0.1}
    filtered = changed(evaluation={"filter": "none"})
    assert filtered.evaluation_filter.kind == "none"
    with pytest.raises(UnknownNameError, match="protect"):
        changed(evaluation={"filter": "protct"})


def test_defaults_and_shorthands():
    experiment = changed()
    (arm,) = experiment.arms
    assert (arm.env.id, arm.env.kwargs) == ("InvertedPendulum-v5", {})
    assert (arm.filter.kind, arm.n_envs, arm.device) == ("none", 1, "cpu")
    assert (arm.normalize.observation, arm.normalize.reward) == (False, False)
    assert experiment.evaluation.episodes == 10
    assert experiment.folder == Path("runs/x")
    assert experiment.workers is None


def test_arms_override_the_common_settings():
    experiment = changed(
        hyperparameters={"n_steps": 64, "gamma": 0.9},
        arms={
            "a": {"filter": {"protect": {"margin": 0.01}}},
            "b": {"hyperparameters": {"gamma": 0.8}, "total_steps": 5, "n_envs": 3, "device": "auto"},
            "c": {
                "algorithm": "SAC",
                "hyperparameters": {"learning_starts": 10},
                "normalize": {"reward": True},
            },
            "d": {"env": {"id": "Pendulum-v1", "kwargs": {"g": 9.0}}, "checkpoint_every": 7},
        },
    )
    a, b, c, d = experiment.arms
    assert (a.filter.kind, a.filter.protect) == ("protect", {"margin": 0.01})
    assert (b.hyperparameters, b.total_steps, b.n_envs) == ({"n_steps": 64, "gamma": 0.8}, 5, 3)
    assert b.device == "auto"
    # Another algorithm does not inherit PPO's hyperparameters.
    assert c.hyperparameters == {"learning_starts": 10}
    assert c.normalize.reward
    assert (d.env.id, d.env.kwargs, d.checkpoint_every) == ("Pendulum-v1", {"g": 9.0}, 7)
    assert experiment.evaluation_filter == a.filter


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"totalsteps": 3}, "config: unknown name 'totalsteps'. Did you mean 'total_steps'?"),
        ({"algorithm": "PP0"}, "algorithm: unknown name 'PP0'. Did you mean 'PPO'?"),
        ({"env": "InvertedPendulums-v5"}, "Did you mean 'InvertedPendulum-v5'?"),
        ({"env": {"id": "Pendulum-v1", "kwarg": {}}}, "env: unknown name 'kwarg'. Did you mean 'kwargs'?"),
        (
            {"hyperparameters": {"nsteps": 3}},
            "hyperparameters of PPO: unknown name 'nsteps'. Did you mean 'n_steps'?",
        ),
        ({"arms": {"a": {"filters": "none"}}}, "arms.a: unknown name 'filters'. Did you mean 'filter'?"),
        (
            {"arms": {"a": {"filter": "protected"}}},
            "a.filter: unknown name 'protected'. Did you mean 'protect'?",
        ),
    ],
)
def test_unknown_names_are_refused_with_the_nearest(settings, message):
    with pytest.raises(UnknownNameError) as refusal:
        changed(**settings)
    assert message in str(refusal.value)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"device": "gpu"}, "device: input should be 'cpu', 'cuda' or 'auto', got 'gpu'."),
        ({"total_steps": 0}, "total_steps: input should be greater than or equal to 1, got 0."),
        ({"total_steps": "many"}, "total_steps: input should be a valid integer, got 'many'."),
        ({"total_steps": True}, "total_steps: input should be a valid integer, got True."),
        ({"n_envs": 1.5}, "n_envs: input should be a valid integer, got 1.5."),
        ({"seeds": []}, "seeds: list should have at least 1 item"),
        ({"seeds": [1, 1]}, "seeds: each may be given once, got [1, 1]."),
        ({"arms": {}}, "arms: expected at least one"),
        ({"arms": {"../x": {}}}, "arms.../x.name: expected a name that can be a folder's"),
        (
            {"arms": {"a": {"filter": False}}},
            "arms.a.filter: expected a mapping of protect, factory, kwargs, lease, escape; got False.",
        ),
        (
            {"arms": {"a": {"filter": {"factory": "no_colon"}}}},
            "factory: expected 'module:function', got 'no_colon'.",
        ),
        (
            {"arms": {"a": {"filter": {"kwargs": {"x": 1}}}}},
            "arms.a.filter: expected none, protect, {protect: {...}}",
        ),
        (
            {"hyperparameters": {"learning_rate": -1}},
            "learning_rate: input should be greater than 0, got -1.",
        ),
        ({"hyperparameters": {"use_sde": 1}}, "use_sde: input should be a valid boolean, got 1."),
    ],
)
def test_bad_values_are_refused(settings, message):
    with pytest.raises(ConfigurationError) as refusal:
        changed(**settings)
    assert message in str(refusal.value)


def test_a_key_without_a_value_has_its_default():
    (arm,) = changed(n_envs=None, normalize=None, workers=None, arms={"a": {"filter": None}}).arms
    assert (arm.n_envs, arm.normalize.reward, arm.filter.kind) == (1, False, "none")
    (arm,) = changed(arms={"a": {"filter": {"protect": None}}}).arms
    assert (arm.filter.kind, arm.filter.protect) == ("protect", {})


@pytest.mark.parametrize("key", sorted(MINIMAL))
def test_missing_settings_are_named(key):
    with pytest.raises(ConfigurationError, match=f"config: '{key}' is missing"):
        parse_experiment({k: v for k, v in MINIMAL.items() if k != key})


def test_yaml_numbers_as_people_write_them(tmp_path):
    path = tmp_path / "c.yaml"
    path.write_text("a: 3e-4\nb: -1E5\nc: 1e\nd: 12\n")
    assert read_config(path) == {"a": 3e-4, "b": -1e5, "c": "1e", "d": 12}


def test_overrides(tmp_path):
    path = tmp_path / "c.yaml"
    path.write_text("a: {b: 1}\nc:\n")
    settings = read_config(path, ["a.b=2", "a.d=[1, 2]", "c.e.f=none", "g=1e3", "g=2"])
    assert settings == {"a": {"b": 2, "d": [1, 2]}, "c": {"e": {"f": "none"}}, "g": 2}


@pytest.mark.parametrize(
    ("text", "override", "message"),
    [
        ("a: 1", "a", "Override 'a': expected key=value, such as total_steps=1000."),
        ("a: 1", "a.b=2", "a.b: a is 1, with no keys inside."),
        ("a: 1", "a={", "override 'a={': not valid YAML"),
        ("a: 1\na: 2", None, "'a' is given twice"),
        ("a: {", None, "not valid YAML"),
        ("- a", None, "expected a mapping of settings"),
        ("a: 2020-01-01", None, "no settings"),
        ("1: 2", None, "1 is no text"),
    ],
)
def test_bad_files_and_overrides(tmp_path, text, override, message):
    path = tmp_path / "c.yaml"
    path.write_text(text)
    with pytest.raises(ConfigurationError) as refusal:
        read_config(path, [override] if override else [])
    assert message in str(refusal.value)
