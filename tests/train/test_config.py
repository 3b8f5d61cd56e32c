"""What a config may say: to the command, to editors by its schema, on the pages, and in the envs that are made.

One table has what is refused, by the command and, where it can know, by the schema.
"""

import json
import re
import runpy
import sys
from dataclasses import fields
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import yaml

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError, SafeWrappersError
from safe_wrappers.plants.env_checks import wrappers_of
from safe_wrappers.train import cli
from safe_wrappers.train.cli import main
from safe_wrappers.train.config import models, parse_experiment, read_config
from safe_wrappers.train.config.algorithms import algorithm_class
from safe_wrappers.train.config.models import EnvConfig, FilterConfig, LearnerConfig, stored_arm
from safe_wrappers.train.experiment import check_training
from safe_wrappers.train.processes.on_ray import check_place
from safe_wrappers.train.run.stack import make_stack
from safe_wrappers.train.run.trackers import check_trackers

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


# What it means ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yaml")), ids=lambda path: path.stem)
def test_every_config_of_the_repo_is_valid_and_fits_the_schema_that_it_names(path):
    assert path.read_text().startswith("# yaml-language-server: $schema=schema.json\n")
    if "sbx." in path.read_text():
        pytest.importorskip("sbx")
    assert fits(read_config(path), SCHEMA)
    # As editors read it: in YAML 1.2 100_000 is a text.
    text = re.sub(r"\b(\d[\d]*_[\d_]*)\b", r'"\1"', path.read_text())
    assert fits(yaml.load(text, yaml.SafeLoader), SCHEMA)
    experiment = parse_experiment(read_config(path))
    assert experiment.name == path.stem
    kinds = {arm.name: arm.filter.kind for arm in experiment.arms}
    assert "none" in kinds.values() or path.stem in ("pointgoal1_learners", "goal_leads")
    assert experiment.evaluation_filter.kind == "protect"


def test_defaults_and_shorthands():
    nothing = {"n_envs": None, "normalize": None, "workers": None}
    for experiment in (changed(), changed(**nothing, arms={"unfiltered": {"filter": None}})):
        (arm,) = experiment.arms
        assert (arm.env.id, arm.env.kwargs) == ("InvertedPendulum-v5", {})
        assert (arm.filter.kind, arm.n_envs, arm.device) == ("none", 1, "cpu")
        assert (arm.normalize.observation, arm.normalize.reward) == (False, False)
        assert experiment.evaluation.episodes == 10
        assert experiment.folder == Path("runs/x")
        assert experiment.workers is None
    (arm,) = changed(arms={"a": {"filter": {"protect": None}}}).arms
    assert (arm.filter.kind, arm.filter.protect) == ("protect", {})


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
    assert c.hyperparameters == {"learning_starts": 10} and c.normalize.reward
    assert (d.env.id, d.env.kwargs, d.checkpoint_every) == ("Pendulum-v1", {"g": 9.0}, 7)
    assert experiment.evaluation_filter == a.filter


def test_an_evaluation_may_name_its_own_filter_which_may_judge():
    assert changed().evaluation_filter.kind == "none"
    on = changed(evaluation={"episodes": 1, "filter": {"protect": {"margin": 0.1}}})
    assert on.evaluation_filter.protect == {"margin": 0.1}
    judged = {"env": {"id": "Reacher-v5", "judge": "constraints"}, "evaluation": {"filter": "protect"}}
    assert changed(**judged).arms[0].env.judge == FilterConfig(protect={})


ARMS = {
    "protect": {"filter": {"protect": {"margin": 0.1}, "lease": {"budget": {"closing_speed": 3.0}}}},
    "factory": {"filter": {"factory": "fake_task:shield", "kwargs": {"margin": None}}},
    "priced": {"hyperparameters": {"clip_range": "linear_0.2"}, "learner": {"cost_limit": 25}},
    "held": {"normalize": {"observation": True}, "action_repeat": 4, "n_envs": 3},
    "seen": {"env": {"id": "SafePointGoal1-v0", "observation": "constraints"}},
    "judged": {"env": {"id": "Reacher-v5", "judge": "constraints"}},
}


def test_an_arm_is_read_back_from_what_its_folder_says():
    for arm in changed(arms=ARMS, evaluation={"filter": "protect"}).arms:
        assert stored_arm(arm.name, json.loads(json.dumps(arm.fingerprint()))) == arm


def test_files_and_overrides_as_people_write_them(tmp_path):
    path = tmp_path / "c.yaml"
    path.write_text("a: {b: 1}\nc:\nd: 3e-4\ne: -1E5\nf: 1e\n")
    read = {"a": {"b": 1}, "c": None, "d": 3e-4, "e": -1e5, "f": "1e"}
    assert read_config(path) == read
    settings = read_config(path, ["a.b=2", "a.d=[1, 2]", "c.e.f=none", "g=1e3", "g=2"])
    assert settings == {**read, "a": {"b": 2, "d": [1, 2]}, "c": {"e": {"f": "none"}}, "g": 2}
    path.write_text("a: {filter: none}\nfilter: protect\nenv: E-v0\nlearner: naive")
    margins = [f"{where}filter.protect.margin=0.1" for where in ("", "a.")]
    found = read_config(path, [*margins, "env.judge=constraints", "learner.penalty=0.1"])
    filtered = {"protect": {"margin": 0.1}}
    assert found == {"a": {"filter": filtered}, "filter": filtered} | {
        "env": {"id": "E-v0", "judge": "constraints"},
        "learner": {"kind": "naive", "penalty": 0.1},
    }


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


# What is refused, before a step is made ---------------------------------------------------------------------------


def of_arm(**settings):
    return {"arms": {"a": settings}}


def of_env(env_id, **settings):
    return {"env": {"id": env_id, **settings}}


def learnt(kind, algorithm="SAC", **settings):
    """A filtered arm with a learner."""
    return {"algorithm": algorithm, **of_arm(filter="protect", learner=kind), **settings}


def judged(env_id, factory, **kwargs):
    judge = {"factory": factory, "kwargs": kwargs}
    return of_env(env_id, judge="constraints") | {"evaluation": {"filter": judge}}


LEASE = {"budget": {"closing_speed": 3.0}, "min_lease_s": 0.02}
SEEN = [  # by the schema, too
    ({"totalsteps": 3}, "config: unknown name 'totalsteps'. Did you mean 'total_steps'?"),
    ({"algorithm": "PP0"}, "algorithm: unknown name 'PP0'. Did you mean 'PPO'?"),
    ({"env": None}, "arms.unfiltered: 'env' is missing."),
    ({"device": "gpu"}, "device: input should be 'cpu', 'cuda' or 'auto', got 'gpu'."),
    ({"total_steps": 0}, "total_steps: input should be greater than or equal to 1, got 0."),
    ({"trackers": ["wand"]}, "input should be 'wandb' or 'mlflow'"),
    ({"seeds": []}, "seeds: list should have at least 1 item"),
    ({"arms": {}}, "arms: expected at least one"),
    ({"normalize": {"reward": 1}}, "normalize.reward: input should be a valid boolean"),
    ({"evaluation": {"filter": "protct"}}, "Did you mean 'protect'?"),
    (of_arm(filter="protected"), "a.filter: unknown name 'protected'. Did you mean 'protect'?"),
    (of_arm(filter=False), "a.filter: expected a mapping of protect, factory, kwargs"),
    (of_arm(filter={"margin": 0.1}), "a.filter: unknown name 'margin'"),
    (of_env("SafePointGoal1-v0", judge="filter"), "env.judge: unknown name 'filter'"),
    (learnt("naiv"), "learner.kind: input should be 'naive'"),
    (learnt({"kind": "adaption_penalty", "penalty": -1}), "penalty: input should be greater than or equal to 0"),
    (learnt({"cost_limit": -1}), "cost_limit: input should be greater than or equal to 0"),
]  # fmt: skip
UNSEEN = [
    ({"env": "InvertedPendulums-v5"}, "Did you mean 'InvertedPendulum-v5'?"),
    ({"hyperparameters": {"nsteps": 3}}, "of PPO: unknown name 'nsteps'. Did you mean 'n_steps'?"),
    ({"hyperparameters": {"learning_rate": -1}}, "learning_rate: input should be greater than 0, got -1."),
    ({"hyperparameters": {"use_sde": 1}}, "use_sde: input should be a valid boolean, got 1."),
    ({"seeds": [1, 1]}, "seeds: each may be given once, got [1, 1]."),
    ({"arms": {"../x": {}}}, "arms.../x.name: expected a name that can be a folder's"),
    # What does not go together.
    (of_arm(filter={"kwargs": {"x": 1}}), "a.filter: expected none, protect, {protect: {...}}"),
    (of_arm(filter={"lease": {}}), "beside it"),
    (of_arm(learner="safe_action", algorithm="SAC"), "without a filter no action is ever changed"),
    (learnt("adaption_penalty"), "adaption_penalty needs a penalty per changed step"),
    (learnt({"kind": "safe_action", "penalty": 1}), "safe_action takes no penalty; adaption_penalty does"),
    (learnt("safe_action", "DQN"), "is for continuous actions, and DQN has"),
    (learnt("safe_action", "PPO"), "Use naive or adaption_penalty, or safe_action with SAC"),
    (learnt("safe_action", hyperparameters={"n_steps": 3}), "has one-step returns"),
    (learnt("naive", hyperparameters={"replay_buffer_kwargs": {}}), "unknown name 'replay_buffer_kwargs'"),
    (learnt("naive", "TD3"), "TD3 is deterministic"),
    (learnt({"cost_limit": 1}, normalize={"reward": True}), "leave normalize out"),
    (learnt("safe_action", "sbx.PPO"), "sbx.PPO cannot learn from the executed action"),
    (learnt("naive", "sbx.PPO", hyperparameters={"target_kl": 0.1}), "target_kl adapts. Leave "),
    (learnt("naive", "sbx.PPO", hyperparameters={"clip_range_vf": 0.1}), "nothing with clip_range_vf"),
    (learnt("naive", "sbx.CrossQ", hyperparameters={"learning_rate": "linear_1e-3"}), "sbx.CrossQ cannot fall"),
    (learnt("naive", "sbx.SAC", device="auto"), "where the environment variable JAX_PLATFORMS says"),
    (of_env("Reacher-v5", judge="constraints"), "env.judge: there is no filter whose constraints"),
    (of_env("Reacher-v5", observation="constraints"), "env.observation: there is no filter whose"),
    (of_env("Reacher-v5", judge="constraints", cost="a:b"), "cost and judge both say"),
    # What only the task can tell.
    (of_env("Pendulum-v1", kwargs={"no_such": 1}), "env: Pendulum-v1 with kwargs {'no_such': 1} cannot be made"),
    (of_env("CartPole-v1") | {"algorithm": "SAC"}, "arms.unfiltered: SAC needs actions of a Box, and CartPole"),
    ({"algorithm": "DQN"}, "arms.unfiltered: DQN needs actions of a Discrete, and InvertedPendulum-v5 has"),
    ({"arms": {"a": {"filter": {"factory": "builtins:print"}}}}, "builtins:print must return the env, filtered"),
    (of_env("MountainCar-v0") | of_arm(filter="protect"), "no recipe for"),
    (of_arm(filter={"factory": "nowhere:shield"}), "filter.factory: cannot import 'nowhere:shield'"),
    (of_arm(filter={"factory": "fake_task:shield", "kwargs": {"no_such": 1}}), "kwargs: shield() got an unexpected"),
    (of_env("Reacher-v5", faults={"Outage": {}}), "'Outage'. Did you mean 'Outages'"),
    (of_env("Reacher-v5", faults={"Outages": {}}), "env.faults.Outages: "),
    (of_env("OccludedCrossing-v0", occlusion={}), "env.occlusion: "),
    (of_env("SafePointGoal1-v0") | of_arm(filter={"protect": {}, "lease": {"budget": {"closing": 1.0}}}), "closing"),
    (of_env("Pusher-v5") | of_arm(filter={"protect": {}, "lease": LEASE}), "2 constraints; say which one"),
    (
        of_env("fake_task:FakeGoal-v0")
        | of_arm(filter={"factory": "fake_task:shield"}, learner={"kind": "adaption_penalty", "penalty": 1}),
        "AdaptionPenalty needs a CBFActionFilter inside",
    ),
    (judged("Reacher-v5", "fake_task:without_h"), "env.judge: RowsOnly has no h "),
    (judged("Pendulum-v1", "fake_task:slow_pendulum", delay_s=0.05), "the filter's plant looks 0.05 s ahead"),
    (judged("Pendulum-v1", "gymnasium:Wrapper"), "env.judge: the filter has no constraints and plant"),
    (of_env("test_algorithms:DictGoal-v0") | {"algorithm": "sbx.PPO"}, "unfiltered: sbx.PPO observes one array"),
    (of_env("test_algorithms:DictGoal-v0", kwargs={"shape": [1, 2]}) | {"algorithm": "sbx.SAC"},
     "arms.unfiltered: sbx.SAC observes one array, or"),
]  # fmt: skip


@pytest.mark.parametrize(("settings", "message"), SEEN + UNSEEN, ids=str)
def test_what_is_refused_and_with_which_words(settings, message):
    if str(settings.get("algorithm")).startswith("sbx."):
        pytest.importorskip("sbx")
    with pytest.raises(SafeWrappersError) as refusal:
        check_training(changed(**settings))
    assert message in str(refusal.value)
    assert fits({**MINIMAL, **settings}, SCHEMA) == ((settings, message) in UNSEEN)


@pytest.mark.parametrize(
    ("package", "use", "extra"),
    [
        ("sb3_contrib", lambda: algorithm_class("TQC"), "contrib"),
        ("sbx", lambda: algorithm_class("sbx.SAC"), "sbx"),
        ("wandb", lambda: check_trackers(changed(trackers=["wandb"]).arms[0]), "wandb"),
        ("ray", lambda: check_place("ray"), "ray"),
    ],
)
def test_a_package_that_is_not_installed_is_named(monkeypatch, package, use, extra):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ConfigurationError, match=rf"pip install 'safe-wrappers\[{extra}\]'"):
        use()


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
    "settings",
    [
        {"n_envs": None, "device": None, "trackers": ["wandb"]},
        {"total_steps": 300_000},
        {"arms": {"filtered": None}},
        of_arm(filter={"protect": {"margin": 0.1}}, learner={"kind": "adaption_penalty", "penalty": 0.1}),
        of_env("SafePointGoal1-v0", observation="constraints") | {"evaluation": {"filter": "protect"}},
    ],
    ids=str,
)
def test_what_the_command_takes_fits_the_schema(settings):
    changed(**settings)
    assert fits({**MINIMAL, **settings}, SCHEMA)


# The pages have every option and every key, with the defaults that there are ---------------------------------------


def rows():
    """Every row of the page's tables, by its key."""
    text = (DOCS / "config.md").read_text(encoding="utf-8")
    keys = runpy.run_path(str(DOCS / "config_keys.py"))["keys"]
    tables = re.findall(r"^```{config-keys} (\w+)\n(?::prefix: (\S+)\n)?```$", text, re.MULTILINE)
    return {key.name: key for section, prefix in tables for key in keys(section, prefix)}


def test_the_page_has_every_field_of_the_models_with_its_meaning_and_what_is_required():
    named = {
        field.name
        for section in vars(models).values()
        if isinstance(section, type) and issubclass(section, models.Section) and section is not models.Section
        for field in fields(section)
    }
    # Those two have keys alone.
    assert named - {"evaluation", "normalize"} <= {name.rpartition(".")[2] for name in rows()}
    assert all(key.meaning for key in rows().values())
    required = {name for name, key in rows().items() if key.default == "required"}
    assert required == MINIMAL.keys() | {"env.id", "sweep.parameters"}
    for key in MINIMAL:
        with pytest.raises(ConfigurationError, match=f"config: '{key}' is missing"):
            parse_experiment({name: value for name, value in MINIMAL.items() if name != key})


def test_every_command_and_option_is_on_its_page():
    text = (DOCS / "cli.md").read_text(encoding="utf-8")
    for command in cli.COMMANDS:
        assert f"| `{command}` |" in text
        for option in re.findall(r"(?<!\w)--[a-z]+\b", cli.make_parser(command).format_help()):
            assert option == "--help" or re.search(rf"`{option}[` ]", text), option


# What it puts around the task -------------------------------------------------------------------------------------


def test_the_stack_has_every_layer_in_its_place():
    outages = {"mean_between_s": 0.2, "mean_length_s": 0.2}
    faults = {"Outages": outages, "RepeatedCommands": {"share": 0.1}}
    filtered = FilterConfig(protect={"margin": 0.1}, lease=LEASE, stuck={"progress": 0.1})
    learner = LearnerConfig("adaption_penalty", penalty=2.0)
    stack = make_stack(EnvConfig("SafePointGoal1-v0", {}, faults), filtered, learner)
    assert stack.penalty == 2.0
    order = ["AdaptionPenalty", "Monitor", "RepeatedCommands", "Outages", "RecordInterventions"]
    order += ["StuckMonitor", "LeaseExpiry", "CBFActionFilter", "OcclusionPenalty"]
    kinds = [type(wrapper).__name__ for wrapper in wrappers_of(stack)]
    assert [kind for kind in kinds if kind in order] == order[:-1]
    occlusion = {
        "tracks": [{"bodies": "car*", "acceleration_noise": [0.0225, 0], "start_position_std": [0.3, 0]}],
        "sensor": {"camera": "eye", "range_m": 6},
        "tolerance": 0.5,
        "weight": 0.1,
    }
    crossing = EnvConfig("OccludedCrossing-v0", {}, {}, occlusion)
    seeing = make_stack(crossing, FilterConfig(protect={"cars": "estimated"}))
    kinds = [type(wrapper).__name__ for wrapper in wrappers_of(seeing)]
    assert [kind for kind in kinds if kind in order] == [order[1], order[4], *order[-2:]]
    stack.reset(seed=0)
    infos = [stack.step(np.array([0.3, 0.1], np.float32))[4] for _ in range(100)]
    assert any(i["fault/active"] for i in infos) and any(i["lease/remaining_s"] > 0.02 for i in infos)
    assert not any(i["cost"] for i in infos)
    assert stack.get_wrapper_attr("filter_time_us") > 0
    (clearance,) = stack.get_wrapper_attr("filter").constraints
    (own,) = sw.protect(gym.make("SafePointGoal1-v0")).constraints
    assert clearance.margin == pytest.approx(own.margin + 0.1)


def test_all_arms_observe_the_same_features():
    env = {"id": "SafePointGoal1-v0", "observation": "constraints"}
    alone = sw.FilterObservation(sw.protect(gym.make("SafePointGoal1-v0"))).reset(seed=3)[0]
    for arm in changed(env=env, arms={"bare": {}, "filtered": {"filter": "protect"}}).arms:
        for used in (arm.filter, FilterConfig()):
            np.testing.assert_array_equal(make_stack(arm.env, used).reset(seed=3)[0], alone)
