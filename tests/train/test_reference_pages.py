"""The pages of the command and of the config have every option and every key, with the defaults that there are."""

import re
import runpy
from dataclasses import fields
from pathlib import Path

from safe_wrappers.train import cli
from safe_wrappers.train.config import models, parse_experiment

DOCS = Path(__file__).parents[2] / "docs"
KEYS = runpy.run_path(str(DOCS / "config_keys.py"))["keys"]


def rows():
    """Every row of the page's tables, by its key."""
    text = (DOCS / "config.md").read_text(encoding="utf-8")
    tables = re.findall(r"^```{config-keys} (\w+)\n(?::prefix: (\S+)\n)?```$", text, re.MULTILINE)
    return {key.name: key for section, prefix in tables for key in KEYS(section, prefix)}


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
