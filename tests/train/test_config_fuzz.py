"""Configs of any kind: an experiment, or a line for people and exit status 1; no traceback, and nothing left behind.

What is drawn: the configs of the repo with settings deleted, renamed, replaced and added; mappings of the schema's
keys with values of any kind; YAML of any kind, and bytes that are none. `make fuzz` draws thousands.
"""

import copy
import json
import math
import os
import warnings
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import get_args, get_type_hints

import pytest
import yaml
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st

from safe_wrappers.errors import SafeWrappersError
from safe_wrappers.protect import protect_options
from safe_wrappers.train.cli import main
from safe_wrappers.train.config import ExperimentConfig, parse_experiment, read_config
from safe_wrappers.train.config.arguments import arguments
from safe_wrappers.train.config.models import ArmConfig
from safe_wrappers.train.config.stored import stored_arm
from safe_wrappers.train.experiment import check_training
from safe_wrappers.wrappers.faults import FAULTS
from safe_wrappers.wrappers.lease_expiry import LeaseExpiry
from safe_wrappers.wrappers.occlusion_penalty import OcclusionPenalty
from safe_wrappers.wrappers.replaced_actions import StuckEscape
from safe_wrappers.wrappers.stopping_budget import StoppingBudget

CONFIGS = {p.stem: p.read_text() for p in sorted((Path(__file__).parents[2] / "configs").glob("*.yaml"))}
MINIMAL = {
    "name": "x",
    "env": {"id": "InvertedPendulum-v5"},
    "algorithm": "PPO",
    "total_steps": 100,
    "arms": {"a": {"filter": {"protect": {}}}},
    "seeds": [0],
}
WORDS = [
    *(
        "",
        "x",
        "none",
        "protect",
        "constraints",
        "PPO",
        "SAC",
        "nan",
        "linear_3e-4",
        "linear_0",
        "a/b",
        "../..",
        "\0",
    ),
    *(
        "math:sqrt",
        "nowhere:f",
        "Pendulum-v1",
        "brake",
        "HerReplayBuffer",
        "wandb",
        "both",
        "é" * 99,
        "a.zip",
    ),
]
NUMBERS = [0, -1, 1, 3, 2**63, 10**30, 0.5, -0.0, 1e-320, 1e308, math.nan, math.inf, -math.inf]
LEAVES = st.one_of(
    st.none(), st.booleans(), st.sampled_from(NUMBERS), st.sampled_from(WORDS), st.text(max_size=4)
)
JUNK = st.recursive(
    st.one_of(LEAVES, st.dates(), st.binary(max_size=3)),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.one_of(st.sampled_from(WORDS), st.integers(), st.none()), inner, max_size=3)
    ),
    max_leaves=4,
)
LINES = [
    "!!python/object/apply:os.abort []",
    *(
        "a: &a [*a]",
        "*nope",
        "<<: 3",
        "? [1]\n: 3",
        "{? {a: 1} : 2}",
        "!!omap [a: 1]",
        "!!set {a}",
        "!!binary 'x'",
    ),
    *(
        "!!bool x",
        "!!int ''",
        "!!float .",
        "!!timestamp x",
        "2020-13-45",
        "2020-01-01",
        "0b",
        "0x_",
        "!mine x",
        "\t- a",
    ),
    *(
        "%YAML 9.9\n---",
        "--- \n---",
        "name: a\nname: b",
        "[" * 2000,
        "0x" + "f" * 5000,
        "9" * 5000,
        ":::",
        "= : 1",
    ),
    "a: &a [1,1,1,1,1,1,1,1]\nb: &b [*a,*a,*a,*a,*a,*a,*a]\nc: &c [*b,*b,*b,*b,*b,*b,*b]\nd: &d [*c,*c,*c,*c,*c,*c]\n"
    "e: &e [*d,*d,*d,*d,*d,*d,*d]\nf: [*e,*e,*e,*e,*e,*e,*e,*e]",
]


def many(default, fuzzing):
    """Examples, and more of them where they are drawn anew in every run."""
    quiet = [HealthCheck.too_slow, HealthCheck.function_scoped_fixture, HealthCheck.data_too_large]
    number = default if settings.default.derandomize else fuzzing
    return settings(max_examples=number, suppress_health_check=quiet)


def places(data, at=()):
    """The keys that lead to each value in it."""
    if at:
        yield at
    for key, value in (
        data.items() if isinstance(data, dict) else enumerate(data if isinstance(data, list) else ())
    ):
        yield from places(value, (*at, key))


def keys_of(section):
    """Fields of a section of the schema: those of its sections as a strategy, the others as None."""
    found = {}
    for name, kind in get_type_hints(section).items():
        inner = next((k for k in (kind, *get_args(kind)) if is_dataclass(k)), None)
        if name in {field.name for field in fields(section)}:
            found[name] = inner
    return found


def of_schema(section):
    """A mapping with some of a section's keys."""
    keys = keys_of(section)
    values = {name: JUNK if inner is None else JUNK | of_schema(inner) for name, inner in keys.items()}
    return st.fixed_dictionaries({}, optional=values)


ARM = of_schema(ArmConfig)
WHOLE = st.builds(
    lambda base, arms, changes: {**base, "arms": arms, **changes},
    st.just(MINIMAL),
    st.dictionaries(st.sampled_from(["a", "b", ".", ""]), ARM, max_size=2),
    st.one_of(st.just({}), of_schema(ExperimentConfig)),
)
KEYS = sorted({*keys_of(ExperimentConfig), *keys_of(ArmConfig)})


@st.composite
def mutated(draw):
    """A config of the repo in which something was changed."""
    found = yaml.safe_load(CONFIGS[draw(st.sampled_from(sorted(CONFIGS)))])
    for _ in range(draw(st.integers(1, 3))):
        every = list(places(found))
        *outer, key = draw(st.sampled_from(every)) if every else ("x",)
        holder = found
        for each in outer:
            holder = holder[each]
        change = draw(st.sampled_from(["delete", "replace", "rename", "add", "swap"]))
        if change == "delete" and every:
            del holder[key]
        elif change == "rename" and isinstance(holder, dict) and every:
            holder[f"{key}x"] = holder.pop(key)
        elif change == "add" and isinstance(holder, dict):
            holder[draw(st.sampled_from(KEYS))] = draw(JUNK)
        elif change == "swap" and every:
            holder[key] = copy.deepcopy(found)
        elif every:
            holder[key] = draw(JUNK)
    return found


@st.composite
def damaged(draw, texts):
    """The text of a config with a line of strange YAML in it, or with other bytes."""
    text = draw(texts)
    at = draw(st.integers(0, len(text)))
    if draw(st.booleans()):
        line = draw(st.sampled_from(LINES))
        before, after = text[:at].rpartition("\n")[::2]
        return f"{before}\n{draw(st.sampled_from(['', 'z: ', '  ']))}{line}\n{after}{text[at:]}".encode()
    return text[:at].encode() + draw(st.binary(max_size=4)) + text[at + draw(st.integers(0, 9)) :].encode()


TEXTS = st.one_of(mutated(), WHOLE).map(yaml.dump)
CONTENTS = st.one_of(
    TEXTS.map(str.encode),
    damaged(TEXTS),
    damaged(st.sampled_from(sorted(CONFIGS.values()))),
    st.binary(max_size=20),
)
OVERRIDES = st.lists(
    st.builds(
        lambda key, value: f"{key}={value}",
        st.sampled_from([*KEYS, "env.id", "arms.a.filter", "arms", "a..b", "."]),
        st.one_of(st.sampled_from(LINES), JUNK.map(lambda junk: yaml.dump(junk, default_flow_style=True))),
    ),
    max_size=2,
)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@many(150, 3000)
@given(content=CONTENTS, overrides=OVERRIDES)
@example(b"", [])
@example(b"\xff\xfe", [])
@example("name: x\n".encode("utf-16"), [])
@example(yaml.dump(MINIMAL | {"env": {"id": "linear_0"}}).encode(), [])
@example(CONFIGS["demo"].encode(), ["seeds=" + "[" * 2000])
def test_a_config_is_an_experiment_or_a_line_for_people(folder, capsys, content, overrides):
    path = folder / "config.yaml"
    path.write_bytes(content)
    try:
        experiment = parse_experiment(read_config(path, overrides))
    except SafeWrappersError as refusal:
        assert str(refusal).strip()
        capsys.readouterr()  # gymnasium-robotics prints news when it is first imported
        assert main(["train", str(path), *overrides]) == 1
        told = capsys.readouterr()
        assert told.err == f"error: {refusal}\n" and not told.out
    else:
        for arm in experiment.arms:  # as the run's folder will have it
            stored = json.dumps(arm.fingerprint(), sort_keys=True)
            again = stored_arm(arm.name, json.loads(stored)).fingerprint()
            assert json.dumps(again, sort_keys=True) == stored
    assert os.listdir(folder) == ["config.yaml"]


def test_a_folder_and_a_file_that_cannot_be_read_are_no_configs(folder, capsys):
    (folder / "config.yaml").mkdir()
    assert main(["train", str(folder / "config.yaml")]) == 1
    assert "There is no config file" in capsys.readouterr().err


def test_aliases_share_nothing(folder):
    path = folder / "config.yaml"
    path.write_text("a: &a {b: 1}\nc: *a\n")
    assert read_config(path, ["a.b=2"]) == {"a": {"b": 2}, "c": {"b": 1}}


@pytest.mark.parametrize("key", ["null", "1", "2.5", "on", "? [a]\n    ", "? {a: 1}\n    "])
def test_a_key_that_is_no_text_is_refused_wherever_it_is(folder, key):
    """JSON, which runs keep their settings in, has no others."""
    path = folder / "config.yaml"
    path.write_text(f"name: x\nenv:\n  kwargs:\n  - {key}: 3\n")
    with pytest.raises(SafeWrappersError, match=r"a key is a text; .* is none \(put it in quotes\)"):
        read_config(path)


@pytest.mark.parametrize("line", LINES)
def test_strange_yaml_is_read_or_refused(folder, line):
    path = folder / "config.yaml"
    path.write_text(f"name: x\nz: {line}\n")
    try:
        assert read_config(path)["name"]
    except SafeWrappersError as refusal:
        assert str(path) in str(refusal)


# What a task, a wrapper or an algorithm refuses ---------------------------------------------------------------


def options_of(names):
    """Some arguments of a wrapper, with values of any kind."""
    return st.dictionaries(st.sampled_from(sorted(names)), LEAVES | JUNK, max_size=3)


BUDGET = [field.name for field in fields(StoppingBudget)]
PARTS = {
    "env.kwargs": options_of(
        ["render_mode", "frame_skip", "xml_file", "reset_noise_scale", "max_episode_steps"]
    ),
    "env.occlusion": options_of(arguments(OcclusionPenalty)),
    "env.faults": st.sampled_from(sorted(FAULTS)).flatmap(
        lambda fault: st.fixed_dictionaries({fault: options_of(arguments(FAULTS[fault]))})
    ),
    "env.reset_options": st.dictionaries(st.sampled_from(["layout", "low", "high"]), JUNK, max_size=2),
    "env.judge": st.just("constraints"),
    "env.observation": st.just("constraints"),
    "arms.a.filter.protect": options_of(protect_options() - {"plant"}),
    "arms.a.filter.escape": options_of(arguments(StuckEscape, "value")),
    "arms.a.filter.lease": st.builds(
        lambda lease, budget: {**lease, "budget": {"closing_speed": 4.0, **budget}},
        options_of(arguments(LeaseExpiry, "plant", "measured")),
        options_of(BUDGET),
    ),
    "arms.a.filter": st.builds(
        lambda name, kwargs: {"factory": name, "kwargs": kwargs},
        st.sampled_from(["safe_wrappers:CBFActionFilter", "safe_wrappers:protect", "nowhere:f", "json:nope"]),
        options_of(["constraints", "margin", "fallback", "plant"]),
    ),
    "arms.a.learner": st.sampled_from(["safe_set_map", "both"]),
    "arms.a.start_from": st.sampled_from(["b", "a.zip", "/", ".zip"]),
    "hyperparameters": options_of(
        ["policy", "policy_kwargs", "ent_coef", "train_freq", "rollout_buffer_class"]
    ),
}


@many(40, 1000)
@given(
    env=st.sampled_from(["InvertedPendulum-v5", "SafePointGoal1-v0", "Pendulum-v1"]),
    parts=st.lists(st.sampled_from(sorted(PARTS)), min_size=1, max_size=2, unique=True),
    data=st.data(),
)
def test_what_cannot_be_trained_is_refused_before_its_first_step(folder, env, parts, data):
    config = copy.deepcopy(MINIMAL) | {"env": {"id": env}}
    for part in parts:
        *outer, key = part.split(".")
        holder = config
        for each in outer:
            holder = holder[each]
        assume(isinstance(holder, dict) and "factory" not in holder)
        holder[key] = data.draw(PARTS[part], label=part)
    path = folder / "config.yaml"
    path.write_text(yaml.dump(config))
    with warnings.catch_warnings(action="ignore"):
        try:
            check_training(parse_experiment(read_config(path)))
        except SafeWrappersError as refusal:
            assert str(refusal).strip()
    assert os.listdir(folder) == ["config.yaml"]


@pytest.mark.parametrize(
    ("env", "override"),
    [
        ("SafePointGoal1-v0", "arms.a.filter.escape={progress: {}}"),
        ("InvertedPendulum-v5", "env.kwargs={render_mode: {}}"),
    ],
)
def test_what_was_once_a_traceback_is_refused(folder, env, override):
    (folder / "config.yaml").write_text(yaml.dump(MINIMAL))
    with pytest.raises(SafeWrappersError, match=r"progress is a finite|cannot be made: AttributeError"):
        check_training(parse_experiment(read_config(folder / "config.yaml", [f"env.id={env}", override])))
