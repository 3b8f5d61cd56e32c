"""The schema of configs takes what the command takes, and marks what it refuses."""

import json
import re
from pathlib import Path

import pytest
import yaml

from safe_wrappers.errors import ConfigurationError
from safe_wrappers.train.cli import main
from safe_wrappers.train.config import parse_experiment, read_config

CONFIGS = Path(__file__).parents[2] / "configs"
SCHEMA = json.loads((CONFIGS / "schema.json").read_text())
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


def as_editors_read(path):
    """YAML 1.2: 100_000 is a text."""
    return yaml.load(re.sub(r"\b(\d[\d]*_[\d_]*)\b", r'"\1"', path.read_text()), yaml.SafeLoader)


def test_the_command_prints_what_lies_beside_the_configs(capsys):
    assert main(["schema"]) == 0
    assert json.loads(capsys.readouterr().out) == SCHEMA, "safe-wrappers schema > configs/schema.json"


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yaml")), ids=lambda path: path.stem)
def test_every_config_fits_and_names_it_for_editors(path):
    assert path.read_text().startswith("# yaml-language-server: $schema=schema.json\n")
    assert fits(read_config(path), SCHEMA)
    assert fits(as_editors_read(path), SCHEMA)


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
