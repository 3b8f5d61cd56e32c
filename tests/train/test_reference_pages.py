"""The pages of the command and of the config have every option and every key, with the defaults that there are."""

import argparse
import re
from dataclasses import fields, is_dataclass
from pathlib import Path

import pytest
import yaml

from safe_wrappers.train import cli, config
from safe_wrappers.wrappers.faults import FAULTS

DOCS = Path(__file__).parents[2] / "docs"
PREFIXES = {
    "ExperimentConfig": "",
    "ArmConfig": "",
    "EnvConfig": "env.",
    "FilterConfig": "filter.",
    "LearnerConfig": "learner.",
    "NormalizeConfig": "normalize.",
    "EvaluationConfig": "evaluation.",
}
"""Where a dataclass of the config stands in a YAML file; a new one needs a place here and on the page."""
WRITTEN = {
    "given_evaluation_filter": "evaluation.filter",
    "filter.kind": "filter",  # `filter: none`, `filter: protect`
}
SECTIONS = {"evaluation", "normalize"}
"""Keys that hold only other keys."""


def rows():
    """Key -> (type, default, meaning) of every table row of the page."""
    text = (DOCS / "config.md").read_text(encoding="utf-8")
    found = re.findall(r"^\| `([\w.]+)` \| (.*) \| (.*) \| (.*) \|$", text, re.MULTILINE)
    assert len({key for key, *_ in found}) == len(found)
    return {key: tuple(rest) for key, *rest in found}


def test_every_key_of_a_config_is_on_its_page():
    classes = [
        value
        for value in vars(config).values()
        if isinstance(value, type) and is_dataclass(value) and value.__module__ == config.__name__
    ]
    names = {PREFIXES[cls.__name__] + field.name for cls in classes for field in fields(cls)}
    keys = {WRITTEN.get(name, name) for name in names} - SECTIONS
    keys |= {*config._COMMON_KEYS, *config._ARM_KEYS} - SECTIONS
    assert keys - rows().keys() == set()
    assert rows().keys() - keys == {"filter.protect"}


def test_the_page_s_defaults_are_those_of_a_config_that_gives_none():
    experiment = config.parse_experiment(
        {
            "name": "x",
            "env": "Pendulum-v1",
            "algorithm": "PPO",
            "total_steps": 10,
            "arms": {"a": {}},
            "seeds": [0],
        }
    )
    (arm,) = experiment.arms
    parts = {
        "env.": arm.env,
        "filter.": arm.filter,
        "learner.": arm.learner,
        "normalize.": arm.normalize,
        "evaluation.": experiment.evaluation,
    }
    for key, (_, default, _) in rows().items():
        if not default.startswith("`") or key == "filter.protect":
            assert default in ("required", "none", "the first filtered arm's") or key == "filter.protect", key
            continue
        prefix = key.partition(".")[0] + "."
        if prefix in parts and "." in key:
            there = getattr(parts[prefix], key.removeprefix(prefix))
        else:
            there = getattr(experiment, key) if hasattr(experiment, key) else getattr(arm, key)
        there = getattr(there, "kind", there)  # filter and learner
        written = yaml.safe_load(default.strip("`"))
        assert written == (str(there) if isinstance(there, Path) else there), key


def test_every_command_and_option_is_on_its_page():
    text = (DOCS / "cli.md").read_text(encoding="utf-8")
    parser = cli._parser()
    (commands,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    assert set(commands.choices) == set(cli._COMMANDS)
    for name, command in commands.choices.items():
        assert f"| `{name}` |" in text
        for action in command._actions:
            for option in action.option_strings:
                assert re.search(rf"`{option}[` ]", text), option
    assert "`--version`" in text


@pytest.mark.parametrize("fault", sorted(FAULTS))
def test_the_page_that_the_config_page_refers_to_has_every_fault(fault):
    assert fault in (DOCS / "wrappers" / "faults.md").read_text(encoding="utf-8")
