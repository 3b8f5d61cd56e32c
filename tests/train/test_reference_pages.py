"""The pages of the command and of the config have every option and every key, with the defaults that there are."""

import re
import runpy
from dataclasses import fields
from pathlib import Path

import pytest
import yaml

from safe_wrappers.train import command_line as cli
from safe_wrappers.train.config import models, parse_experiment
from safe_wrappers.wrappers.faults import FAULTS

DOCS = Path(__file__).parents[2] / "docs"
KEYS = runpy.run_path(str(DOCS / "config_keys.py"))["keys"]


def rows():
    """Every row of the page's tables, by its key."""
    text = (DOCS / "config.md").read_text(encoding="utf-8")
    tables = re.findall(r"^```{config-keys} (\w+)\n(?::prefix: (\S+)\n)?```$", text, re.MULTILINE)
    found = [key for section, prefix in tables for key in KEYS(section, prefix)]
    assert len({key.name for key in found}) == len(found)
    return {key.name: key for key in found}


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


def test_the_page_s_defaults_are_those_of_a_config_that_gives_none():
    given = {
        "name": "x",
        "env": "Pendulum-v1",
        "algorithm": "PPO",
        "total_steps": 10,
        "arms": {"a": {}},
        "seeds": [0],
    }
    experiment = parse_experiment(given)
    required = {name for name, key in rows().items() if key.default == "required"}
    assert required == given.keys() | {"env.id", "learner.margin_curriculum.start", "sweep.parameters"}
    parameter = models.ParameterConfig(choices=[1, 2])
    optional = {  # not there if they are not given
        "learner": models.MarginCurriculumConfig(start=0.1),
        "sweep": models.SweepConfig(parameters={"KEY": parameter}),
    }
    own = {"low", "high", "choices"}  # one of both ways has to be given
    assert {key.name for key in KEYS("ParameterConfig") if key.default == "`null`"} == own | {"step"}
    for name in rows().keys() - required - {f"sweep.parameters.KEY.{key}" for key in own}:
        there = experiment if hasattr(experiment, name.partition(".")[0]) else experiment.arms[0]
        for part in name.split("."):
            there = optional[name.split(".")[0]] if there is None else there
            there = there[part] if isinstance(there, dict) else getattr(there, part)
        there = getattr(there, "kind", there)  # filter and learner
        written = yaml.safe_load(rows()[name].default.strip("`"))
        assert written == (str(there) if isinstance(there, Path) else there), name


def test_types_are_told_as_a_yaml_file_has_them():
    told = {
        name: rows()[name].type
        for name in ("arms", "seeds", "env", "env.judge", "device", "workers", "output")
    }
    assert told == {
        "arms": "mapping",
        "seeds": "list of integers",
        "env": "text or mapping",
        "env.judge": "`constraints`",
        "device": "`cpu`, `cuda`, `auto`",
        "workers": "integer",
        "output": "path",
    }


def test_every_command_and_option_is_on_its_page():
    text = (DOCS / "cli.md").read_text(encoding="utf-8")
    options = re.findall(r"(?<!\w)--?[a-z]+\b", cli.make_parser().format_help())
    assert {"-h", "--report", "--output"} <= set(options)
    for option in options:
        assert re.search(rf"`{option}[` ]", text), option
    for command in cli.COMMANDS:
        assert f"| `{command}` |" in text


@pytest.mark.parametrize("fault", sorted(FAULTS))
def test_the_page_that_the_config_page_refers_to_has_every_fault(fault):
    assert fault in (DOCS / "wrappers" / "faults.md").read_text(encoding="utf-8")
