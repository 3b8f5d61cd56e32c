"""What a config may say: as the command reads it, as its schema tells editors, and as the pages have it."""

import json
import re
import runpy
from dataclasses import fields
from pathlib import Path

import pytest
import yaml

from safe_wrappers.errors import ConfigurationError
from safe_wrappers.train import cli
from safe_wrappers.train.cli import main
from safe_wrappers.train.config import FilterConfig, models, parse_experiment, read_config

ROOT = Path(__file__).parents[2]
CONFIGS, DOCS = ROOT / "configs", ROOT / "docs"
SCHEMA = json.loads((CONFIGS / "schema.json").read_text())
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
def test_every_config_of_the_repo_is_valid_and_fits_the_schema_that_it_names(path):
    assert path.read_text().startswith("# yaml-language-server: $schema=schema.json\n")
    assert fits(read_config(path), SCHEMA)
    # As editors read it: in YAML 1.2 100_000 is a text.
    text = re.sub(r"\b(\d[\d]*_[\d_]*)\b", r'"\1"', path.read_text())
    assert fits(yaml.load(text, yaml.SafeLoader), SCHEMA)
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
    judged = {"env": {"id": "Reacher-v5", "judge": "constraints"}, "evaluation": {"filter": "protect"}}
    assert changed(arms=arms, **judged).arms[0].env.judge == FilterConfig(protect={})


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
        ({"hyperparameters": {"nsteps": 3}}, "of PPO: unknown name 'nsteps'. Did you mean 'n_steps'?"),
        (
            {"arms": {"a": {"filter": "protected"}}},
            "a.filter: unknown name 'protected'. Did you mean 'protect'?",
        ),
        ({"evaluation": {"filter": "protct"}}, "Did you mean 'protect'?"),
        ({"device": "gpu"}, "device: input should be 'cpu', 'cuda' or 'auto', got 'gpu'."),
        ({"total_steps": 0}, "total_steps: input should be greater than or equal to 1, got 0."),
        ({"seeds": []}, "seeds: list should have at least 1 item"),
        ({"seeds": [1, 1]}, "seeds: each may be given once, got [1, 1]."),
        ({"arms": {}}, "arms: expected at least one"),
        ({"arms": {"../x": {}}}, "arms.../x.name: expected a name that can be a folder's"),
        ({"arms": {"a": {"filter": False}}}, "a.filter: expected a mapping of protect, factory, kwargs"),
        (
            {"arms": {"a": {"filter": {"kwargs": {"x": 1}}}}},
            "a.filter: expected none, protect, {protect: {...}}",
        ),
        ({"arms": {"a": {"filter": {"lease": {}}}}}, "beside it"),
        ({"arms": {"a": {"learner": {"kind": "safe_action"}}}}, "without a filter no action is ever changed"),
        (
            {"hyperparameters": {"learning_rate": -1}},
            "learning_rate: input should be greater than 0, got -1.",
        ),
        ({"hyperparameters": {"use_sde": 1}}, "use_sde: input should be a valid boolean, got 1."),
        (
            {"env": {"id": "Reacher-v5", "judge": "constraints"}},
            "env.judge: there is no filter whose constraints",
        ),
        (
            {"env": {"id": "Reacher-v5", "observation": "constraints"}},
            "env.observation: there is no filter whose",
        ),
        ({"env": {"id": "Reacher-v5", "judge": {"protect": {}}, "cost": "a:b"}}, "cost and judge both say"),
    ],
)
def test_unknown_names_and_bad_values_are_refused_with_what_is_valid(settings, message):
    with pytest.raises(ConfigurationError) as refusal:
        changed(**settings)
    assert message in str(refusal.value)


def test_a_key_without_a_value_has_its_default():
    (arm,) = changed(n_envs=None, normalize=None, workers=None, arms={"a": {"filter": None}}).arms
    assert (arm.n_envs, arm.normalize.reward, arm.filter.kind) == (1, False, "none")
    (arm,) = changed(arms={"a": {"filter": {"protect": None}}}).arms
    assert (arm.filter.kind, arm.filter.protect) == ("protect", {})


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


# The schema -------------------------------------------------------------------------------------------------------

TYPES = {
    "object": dict, "array": list, "string": str, "boolean": bool, "integer": int, "number": (int, float),
    "null": type(None),
}  # fmt: skip


def fits(value, schema):
    """Whether a value is what a schema says: the words of JSON schema that ours has."""
    if isinstance(schema, bool):
        return schema
    if "$ref" in schema:
        return fits(value, SCHEMA["$defs"][schema["$ref"].rpartition("/")[2]])
    if "anyOf" in schema and not any(fits(value, one) for one in schema["anyOf"]):
        return False
    if "enum" in schema and value not in schema["enum"]:
        return False
    if "const" in schema and value != schema["const"]:
        return False
    kind = schema.get("type")
    if kind and (not isinstance(value, TYPES[kind]) or (isinstance(value, bool) and kind != "boolean")):
        return False
    if isinstance(value, str) and not re.search(schema.get("pattern", ""), value):
        return False
    if isinstance(value, int | float) and not isinstance(value, bool):
        if value < schema.get("minimum", value) or value > schema.get("maximum", value):
            return False
        return "exclusiveMinimum" not in schema or value > schema["exclusiveMinimum"]
    if isinstance(value, list):
        return len(value) >= schema.get("minItems", 0) and all(
            fits(one, schema.get("items", {})) for one in value
        )
    if isinstance(value, dict):
        known, others = schema.get("properties", {}), schema.get("additionalProperties", {})
        if not set(schema.get("required", ())) <= value.keys() or len(value) < schema.get("minProperties", 0):
            return False
        return all(fits(one, known.get(key, others)) for key, one in value.items())
    return True


def test_the_command_prints_what_lies_beside_the_configs(capsys):
    assert main(["schema"]) == 0
    assert json.loads(capsys.readouterr().out) == SCHEMA, "safe-wrappers schema > configs/schema.json"


@pytest.mark.parametrize(
    ("change", "taken"),
    [
        ("n_env=4", False), ("algorithm=PPPO", False), ("n_envs=0", False), ("device=gpu", False),
        ("arms.filtered.filter=protekt", False), ("arms.filtered.filter={margin: 0.1}", False), ("seeds=0", False),
        ("arms.filtered.learner.kind=naiv", False), ("normalize.reward=1", False),
        ("env={id: SafePointGoal1-v0, judge: filter}", False), ("seeds=[]", False),
        ("arms={}", False), ("total_steps=-1", False), ("evaluation.episodes=many", False), ("env=", False),
        ("n_envs=", True), ("arms.filtered=", True), ("arms.filtered.filter={protect: {margin: 0.1}}", True),
        ("total_steps=3e5", True), ("arms.filtered.learner={kind: adaption_penalty, penalty: 0.1}", True),
        ("env={id: SafePointGoal1-v0, observation: constraints}", True), ("trackers=[wandb]", True),
        ("device=", True),
    ],
)  # fmt: skip
def test_it_says_what_the_command_says(change, taken):
    settings = read_config(CONFIGS / "pointgoal1_300k.yaml", [change])
    if taken:
        parse_experiment(settings)
    else:
        with pytest.raises(ConfigurationError):
            parse_experiment(settings)
    whole = {
        key: int(value) if isinstance(value, float) and value.is_integer() else value
        for key, value in settings.items()
    }
    assert fits(whole, SCHEMA) == taken


# The pages have every option and every key, with the defaults that there are ---------------------------------------


def rows():
    """Every row of the page's tables, by its key."""
    text = (DOCS / "config.md").read_text(encoding="utf-8")
    keys = runpy.run_path(str(DOCS / "config_keys.py"))["keys"]
    tables = re.findall(r"^```{config-keys} (\w+)\n(?::prefix: (\S+)\n)?```$", text, re.MULTILINE)
    return {key.name: key for section, prefix in tables for key in keys(section, prefix)}


def test_every_field_of_the_models_is_on_the_page():
    sections = [
        value
        for value in vars(models).values()
        if isinstance(value, type) and issubclass(value, models.Section) and value is not models.Section
    ]
    shown = {name.rpartition(".")[2] for name in rows()}
    names = {(section.__name__, field.name) for section in sections for field in fields(section)}
    # Those two hold only other keys, and an arm's name is its key in `arms`.
    left_out = {("ArmConfig", "normalize"), ("ExperimentConfig", "evaluation")}
    assert {name for _, name in names - left_out} <= shown
    assert len(rows()) == len(names - left_out - {("ArmConfig", "name")})
    assert all(key.meaning for key in rows().values())


def test_the_page_s_required_keys_are_those_of_a_config():
    given = {"name": "x", "env": "Pendulum-v1", "algorithm": "PPO", "total_steps": 9, "arms": {"a": {}}}
    parse_experiment({**given, "seeds": [0]})
    required = {name for name, key in rows().items() if key.default == "required"}
    inner = {"env.id", "sweep.parameters"}
    assert required == given.keys() | {"seeds"} | inner


def test_every_command_and_option_is_on_its_page():
    text = (DOCS / "cli.md").read_text(encoding="utf-8")
    for command in cli.COMMANDS:
        assert f"| `{command}` |" in text
        for option in re.findall(r"(?<!\w)--[a-z]+\b", cli.make_parser(command).format_help()):
            assert option == "--help" or re.search(rf"`{option}[` ]", text), option
