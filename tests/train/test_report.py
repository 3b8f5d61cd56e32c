"""The report: whole, alone, of what was measured, and in words that say no more than the numbers."""

import base64
import json
import re
from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from running import JUDGES_NOTHING, SILENT, episode, fill, steps, trained, write_evaluation

from safe_wrappers.errors import RunStateError
from safe_wrappers.train import videos
from safe_wrappers.train.evaluation.summary import Curve, summarize
from safe_wrappers.train.policies import write_card
from safe_wrappers.train.report import verdict, write_report
from safe_wrappers.train.report.figures import curve_picture, place_pictures, telling_pair


class Page(HTMLParser):
    """Tags and text of a page, with its tag balance checked."""

    VOID = ("meta", "link", "br", "img")

    def __init__(self, text):
        super().__init__()
        self.tags, self.text, self._open = [], [], []
        self.feed(text)
        assert not self._open

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self._open.append(tag)

    def handle_endtag(self, tag):
        if tag not in self.VOID:
            assert self._open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def words(path):
    """A page's text, spaces as one."""
    return " ".join(" ".join(Page(path.read_text()).text).split())


def reported(experiment):
    """What the page of an experiment says."""
    return words(write_report(experiment, summarize(experiment)))


# The page ---------------------------------------------------------------------------------------------------------


def test_the_page_is_whole_alone_and_of_what_was_measured(finished, monkeypatch):
    experiment = finished()
    monkeypatch.setattr(
        videos, "run_jobs", lambda jobs, *_: [job.call(*job.arguments, SILENT) for job in jobs]
    )
    videos.record_videos(experiment, None)
    path = write_report(experiment, summarize(experiment), "safe-wrappers compare a&b.yaml")
    page = Page(path.read_text())
    links = [attrs[key] for _, attrs in page.tags for key in ("href", "src", "srcset") if key in attrs]
    assert links and all(link.startswith("data:") for link in links)
    assert not re.search(r"https?://|@import|<script", path.read_text())
    alts = [attrs["alt"] for tag, attrs in page.tags if tag == "img"]  # for those who cannot see
    assert len(alts) == len(set(alts)) >= 4 + 3  # films, curves
    assert all(len(text) > 30 and text.endswith(".") for text in alts)
    said = words(path)
    for expected in (
        "PPO on fake_task:FilmedGoal-v0, 512 steps, 2 seeds; evaluation on 3 episodes",
        "of 1,080 steps",
        "mean over 2 seeds [their range, not an interval]",
        "policies of training seed 0: ",
        "by the names of Krasowski et al., TMLR 2023: filtered naive",
        "safe-wrappers compare a&b.yaml",
        "learning_rate: 0.001",
        "Cost in substeps / episode",
    ):
        assert expected in said, expected
    parts = ("Return per evaluation", "In numbers", "The same episode", "While training", "How it was made")
    assert re.search(".*".join(parts), said)


def test_training_alone_with_one_seed_and_without_a_filter(fake_experiment):
    experiment = fake_experiment("seeds=[0]", "env=InvertedPendulum-v5", "arms={unfiltered: {filter: none}}")
    with pytest.raises(RunStateError, match=r"Nothing to report in .* yet; run `safe-wrappers compare`"):
        reported(experiment)
    trained(experiment, 0)
    said = reported(experiment)
    assert "There is no filter to compare with yet." in said and "[n/a]" in said and "over them" not in said
    assert "Violations are not judged: the task reports no cost." in said and "0 of" not in said
    assert "No recorded steps with a filter on." in said and "No videos." in said
    assert "Training, all episodes" in said and "Evaluation, filter" not in said


def test_constraints_places_and_what_was_left_out(fake_experiment):
    experiment = fake_experiment("arms.filtered.learner={kind: adaption_penalty, penalty: 1}")
    flags = np.arange(200) % 4 == 0
    log = steps(
        intervened=flags,
        correction=np.where(flags, np.linspace(0.1, 2.0, 200), 0.0).astype(np.float32),
        refused=np.column_stack([flags, ~flags, np.zeros(200, dtype=bool)]),
        constraint_names=np.array(["Reach<1>", "Speed", "Workspace"]),
        left_out=7,
    )
    fill(experiment, {"violations": 1}, {"infeasible": 1, "fallback": 1}, steps(violated=flags), log)
    said = reported(experiment)
    for expected in (
        "of 400 actions refused by Speed 75 %, Reach<1> 25 %. Never acted: Workspace",
        f"Half of its 100 corrections were below {np.median(log.correction[flags]):.3g}, the largest 1.97",
        "Where violations were: unfiltered, filter off",
        "Where the filter stepped in: filtered",
        "From the first 20,000 steps of each run; 28 more were evaluated but not kept.",
        "TMLR 2023: filtered adaption_penalty",
    ):
        assert expected in said, expected


HOSTILE = "\"'><script>alert(1)<b onload=x a='\n```&amp;|# "


def renamed(fake_experiment, word):
    """A comparison that was never run, whose every name and text has the word in it, also if a config refuses it."""
    experiment = fake_experiment(f"name=of_{len(word)}", "seeds=[0]")
    for part in (experiment, *experiment.arms, *(arm.env for arm in experiment.arms)):
        at = "id" if hasattr(part, "id") else "name"
        object.__setattr__(part, at, f"{getattr(part, at)}{word}")
    for arm in experiment.arms:
        for options in (arm.env.kwargs, arm.hyperparameters, arm.filter.kwargs):
            options[word] = word
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
    return experiment


def test_no_word_becomes_markup(fake_experiment, tmp_path):
    pages, markup = [], []
    for word in (HOSTILE, "plain\n"):  # also in two lines, which are drawn as two
        experiment = renamed(fake_experiment, word)
        pages.append(write_report(experiment, summarize(experiment), word).read_text())
        markup.append({(tag, *sorted(attributes)) for tag, attributes in Page(pages[-1]).tags})
    assert "script&gt;alert(1)" in pages[0] and markup[0] == markup[1]
    assert re.findall(r".{,60}<(?:script|b onload)", pages[0]) == []

    policy = tmp_path / "policy"  # and in the card of a policy
    policy.mkdir()
    config = {"timesteps": 10, "versions": {HOSTILE: HOSTILE}, "constraints": [HOSTILE]}
    (policy / "config.json").write_text(json.dumps(config))
    write_card(renamed(fake_experiment, HOSTILE).arms[1], 0, tmp_path)
    outside = card = (policy / "README.md").read_text()
    code = re.findall(r"^`[^`\n]+`", card) + re.findall(r"(?<!`)`[^`\n]+`(?!`)", card)
    for part in code:
        outside = outside.replace(part, "")
    told = outside.splitlines()
    assert told[0] == "---" == told[3] and "\n# PPO on " in card  # what is between them is JSON
    assert "<" not in "".join(told[4:]) and "script" in "".join(code)
    assert "```" not in "".join(told[4:]).replace("```python", "", 1).replace("```", "", 1)


# The verdict. Training: 10 episodes of 100 steps for each of 2 seeds; evaluation 2 each: 2,400 steps a side -------


HURT = {"violations": 5}
LESS = {"violations": 1}
UNJUDGED = JUDGES_NOTHING | {"unsafe": 3}


@pytest.mark.parametrize(
    ("off", "on", "sentence"),
    [
        (HURT, {}, "With the filter none of 2,400 steps was in violation; without it 120 of 2,400 steps (5 %) were."),
        (HURT, LESS, "lowered violations without removing them: 24 of 2,400 steps (1 %) with it, 120 of 2,400 steps"),
        (LESS, LESS, "The filter did not lower violations: 24 of 2,400 steps (1 %) with"),
        ({}, {}, "none without it: the task did not put it to the test."),
        (LESS, {"intervention_rate": 0.25}, "The filter changed 25 % of the evaluation steps."),
        (LESS, {"intervention_rate": 1e-5}, "changed less than 0.01 % of the evaluation steps."),
        (LESS, {"infeasible": 2, "fallback": 3}, "with it 48 steps were infeasible and 72 ran the fallback."),
        (JUDGES_NOTHING, UNJUDGED, "72 of 2,400 steps with it began outside the safe set."),
    ],
)  # fmt: skip
def test_the_verdict_says_what_the_numbers_say(fake_experiment, off, on, sentence):
    experiment = fake_experiment()
    fill(experiment, off, on)
    said = " ".join(verdict(experiment, summarize(experiment)))
    assert sentence in said
    if off is JUDGES_NOTHING:
        assert said.startswith("Violations are not judged") and "in violation" not in said


def test_of_the_same_policies_only_the_evaluation_is_compared(fake_experiment):
    of = "{filter: {factory: 'fake_task:shield'}}"
    experiment = fake_experiment(f"arms={{a: {of}, b: {of}}}")
    fill(experiment, HURT, {})
    said = " ".join(verdict(experiment, summarize(experiment)))
    assert "none of 400 steps was in violation; without it 20 of 400 steps (5 %)" in said
    assert "with 20 of 400 steps in violation" in said  # beside the return


@pytest.mark.parametrize(
    ("seeds", "spread", "surely"),
    [
        (1, 0.0, "one seed says little"),
        (2, 0.1, "2 seeds say little"),
        (3, 0.1, "the intervals over 3 seeds lie apart"),
        (3, 9.0, "the intervals over 3 seeds overlap"),
    ],
)
def test_the_verdict_names_what_either_policy_returns_and_how_surely(fake_experiment, seeds, spread, surely):
    experiment = fake_experiment(f"seeds={list(range(seeds))}")
    means = {(0, "filter_off"): 21.1, (0, "filter_on"): 12.7, (1, "filter_off"): 9.4, (1, "filter_on"): 5.03}
    for seed in experiment.seeds:
        for (arm, condition), mean in means.items():
            row = episode(**{"return": mean + spread * (seed - (seeds - 1) / 2)})
            write_evaluation(experiment, arm, seed, condition, [row])
    _, returns, choice, *_ = verdict(experiment, summarize(experiment))
    said = [float(each) for each in re.findall(r"filter (?:off|on) (-?[\d.]+) \[", returns)]
    assert said == pytest.approx([*means.values()], abs=0.06)
    assert f"trained without it returned more ({surely})." in choice


# Pictures: their sentences against planted numbers, and what they are drawn from -----------------------------------


def test_a_curve_says_where_it_begins_and_ends():
    seeds = np.array([np.linspace(0, 10, 20), np.linspace(0, 30, 20)])
    curve = Curve(np.arange(20.0), seeds.mean(axis=0), *seeds, seeds)
    picture = curve_picture("Return", "return", {"bare": curve}, ["bare"])
    assert picture.reading.endswith(": “bare” 0.526 to 19.5.")


def test_where_in_state_space():
    rng = np.random.default_rng(0)
    places = rng.uniform(-1, 1, (4000, 3)).astype(np.float32)
    away = np.hypot(places[:, 0] - 0.5, places[:, 2])  # from x = 0.5, speed = 0
    log = steps(4000, coordinates=places, intervened=away < 0.2)
    bare = steps(4000, coordinates=places, violated=away < 0.1)
    hurt, picture = place_pictures("safe", log, "bare", bare)
    x, _, speed = np.median(places[away < 0.2], axis=0)
    share = f"{100 * log.intervened.mean():.2g} % of 4,000 steps were changed"
    assert picture.reading == f"{share}; in the middle of them ({x:.2g}, {speed:.2g})."
    assert hurt.title == "Where violations were: bare, filter off" and "were in violation" in hurt.reading
    kind, data = picture.image.split(",")
    drawn = ElementTree.fromstring(base64.b64decode(data)).iter()
    written = {"".join(node.itertext()) for node in drawn if node.tag.endswith("text")}
    assert kind == "data:image/svg+xml;base64"
    assert {"x (m)", "speed (m/s)", "share of steps changed"} <= written
    flat = {"coordinates": np.zeros((200, 2)), "coordinate_names": np.array(["x", "y"])}
    narrow = {"coordinates": np.zeros((200, 1)), "coordinate_names": np.array(["x"])}
    for log, reading in (
        (steps(), "Nowhere: none of 200 steps"),
        (steps(intervened=np.ones(200, dtype=bool)), "Everywhere: all of 200 steps"),
        (steps(intervened=np.arange(200) == 0, **narrow), "fewer than two coordinates"),
        (steps(intervened=np.arange(200) == 0, **flat), "0.5 % of 200 steps"),
    ):
        assert reading in place_pictures("safe", log, "bare", None)[0].reading


NOISE = np.random.default_rng(1).normal(size=(3000, 6))
PLANTED = {
    "a ring": lambda a, b: np.abs(np.hypot(a, b) - 1.0) < 0.25,
    "opposite corners": lambda a, b: a * b > 0.5,
    "a corner": lambda a, b: (a > 1.0) & (b < -0.5),
}


@pytest.mark.parametrize("planted", PLANTED)
@settings(max_examples=5)
@given(columns=st.permutations(range(6)))
def test_the_planted_pair_is_found_wherever_it_is_in_any_unit(planted, columns):
    a, b = columns[:2]
    chosen = PLANTED[planted](NOISE[:, a], NOISE[:, b])
    assert telling_pair(np.exp(NOISE) * 1e4, chosen) == (min(a, b), max(a, b))
