"""Words that would be markup stay words, on the page and in the model card, also those that a config refuses."""

import json
import re

import numpy as np
from made_up import fill, steps
from test_report import Page

from safe_wrappers.train.evaluation.summary import summarize
from safe_wrappers.train.policies import write_card
from safe_wrappers.train.report import write_report

HOSTILE = "\"'><script>alert(1)<b onload=x a='\n```&amp;|# "
PLAIN = "plain\n"  # also in two lines, which are drawn as two


def markup(text):
    """Which tags with which attributes a page has."""
    return {(tag, *sorted(attributes)) for tag, attributes in Page(text).tags}


def renamed(fake_experiment, word):
    """A comparison that was never run, whose every name and text has the word in it."""
    experiment = fake_experiment(f"name=of_{len(word)}", "seeds=[0]")
    for part in (experiment, *experiment.arms, *(arm.env for arm in experiment.arms)):
        at = "id" if hasattr(part, "id") else "name"
        object.__setattr__(part, at, f"{getattr(part, at)}{word}")
    for arm in experiment.arms:
        for settings in (arm.env.kwargs, arm.hyperparameters, arm.filter.kwargs):
            settings[word] = word
        object.__setattr__(arm.filter, "factory", f"module:{word}")
        object.__setattr__(arm.env, "cost", f"module:{word}")
        object.__setattr__(arm, "trackers", [word])
    log = steps(
        intervened=np.ones(200, dtype=bool),
        refused=np.ones((200, 1), dtype=bool),
        constraint_names=np.array([f"constraint{word}"]),
        coordinate_names=np.array([f"{axis}{word} (m)" for axis in "xyz"]),
    )
    fill(experiment, {"violations": 5, "cost": 50, "return": 20}, {"return": 10}, log, log)
    start = json.dumps({"from": word, "timesteps": 10})
    (experiment.run_folder(experiment.arms[1], 0) / "start.json").write_text(start)
    return experiment


def page(fake_experiment, word):
    experiment = renamed(fake_experiment, word)
    return write_report(experiment, summarize(experiment), word).read_text()


def test_no_word_becomes_markup(fake_experiment):
    hostile, plain = (page(fake_experiment, word) for word in (HOSTILE, PLAIN))
    assert "script&gt;alert(1)" in hostile
    assert re.findall(r".{,60}<(?:script|b onload)", hostile) == []
    assert markup(hostile) == markup(plain)


def test_no_word_becomes_markup_in_the_card(fake_experiment, tmp_path):
    arm = renamed(fake_experiment, HOSTILE).arms[1]
    policy = tmp_path / "policy"
    policy.mkdir()
    config = {"timesteps": 10, "versions": {HOSTILE: HOSTILE}, "constraints": [HOSTILE]}
    (policy / "config.json").write_text(json.dumps(config))
    write_card(arm, 0, tmp_path)
    card = (policy / "README.md").read_text()
    code = re.findall(r"^`[^`\n]+`", card) + re.findall(r"(?<!`)`[^`\n]+`(?!`)", card)
    outside = card
    for part in code:
        outside = outside.replace(part, "")
    told = outside.splitlines()
    assert told[0] == "---" == told[3] and "\n# PPO on " in card  # what is between them is JSON
    assert "<" not in "".join(told[4:]) and "script" in "".join(code)
    assert "```" not in "".join(told[4:]).replace("```python", "", 1).replace("```", "", 1)
