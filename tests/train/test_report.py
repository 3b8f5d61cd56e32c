"""The page: whole, alone, in words for everybody, and of what was measured."""

import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from made_up import SILENT as JUDGES_NOTHING
from made_up import fill, steps

from safe_wrappers.errors import RunStateError
from safe_wrappers.train import videos
from safe_wrappers.train.config import parse_experiment, read_config
from safe_wrappers.train.evaluation.evaluate import evaluate_run
from safe_wrappers.train.evaluation.summary import summarize
from safe_wrappers.train.report import write_report
from safe_wrappers.train.run import Progress, train_run
from safe_wrappers.train.videos import record_videos

HERE = Path(__file__).parent
SILENT = Progress(lambda steps: None, pytest.fail)


def run_all(experiment, evaluate=True):
    """Trains and evaluates in this process; returns the report's path."""
    for arm in experiment.arms:
        for seed in experiment.seeds:
            folder = experiment.run_folder(arm, seed)
            train_run(arm, seed, folder, SILENT)
            if evaluate:
                evaluate_run(arm, seed, folder, experiment.evaluation, experiment.evaluation_filter, SILENT)
    return write_report(experiment, summarize(experiment))


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


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """The fake experiment's page with films; trained once for all tests that only look at it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(HERE))
        patch.setattr(videos, "run_jobs", lambda jobs, *_: [job.call(*job.arguments, SILENT) for job in jobs])
        overrides = [f"output={tmp_path_factory.mktemp('report')}", "env=fake_task:FilmedGoal-v0"]
        experiment = parse_experiment(read_config(HERE / "fake.yaml", overrides))
        run_all(experiment)
        record_videos(experiment, None)
        yield write_report(experiment, summarize(experiment), "safe-wrappers compare a&b.yaml")


def test_the_page_is_whole_and_asks_for_nothing_from_outside(report):
    page = Page(report.read_text())
    links = [attrs[key] for _, attrs in page.tags for key in ("href", "src", "srcset") if key in attrs]
    assert links and all(link.startswith("data:") for link in links)
    assert not re.search(r"https?://|@import|<script", report.read_text())


def test_every_picture_has_words_for_those_who_cannot_see_it(report):
    alts = [attrs["alt"] for tag, attrs in Page(report.read_text()).tags if tag == "img"]
    assert len(alts) == 4 + 3  # films, curves
    assert all(len(text) > 30 and text.endswith(".") for text in alts)
    assert len(set(alts)) == len(alts)


def test_what_the_page_says(report):
    said = words(report)
    for expected in (
        "PPO on fake_task:FilmedGoal-v0, 512 steps, 2 seeds; evaluation on 3 episodes",
        "With the filter on, films show what it knows",
        "of 1,080 steps",
        "Trained without the filter, filter on",
        "Of 1,080 steps with it 0 steps were infeasible and 0 ran the fallback.",
        "mean over 2 seeds [their range, not an interval]",
        "trained through the filter, learner naive",
        "policies of training seed 0: ",
        "changed. Shown 0.5 times as fast as real.",
        "Which constraint refused",
        "Faint lines are seeds, the band is the range over them.",
        "by the names of Krasowski et al., TMLR 2023: filtered naive",
        "safe-wrappers compare a&b.yaml",
        "learning_rate: 0.001",
        "Evaluation, filter on",
        "Cost in substeps / episode",
        "Control steps in which the task itself reports a cost",
    ):
        assert expected in said, expected
    parts = (
        "Return per evaluation episode",
        "In numbers",
        "The same episode",
        "While training",
        "How it was made",
    )
    order = [said.index(part) for part in parts]
    assert order == sorted(order)


def test_one_seed_no_interval(fake_experiment):
    said = words(run_all(fake_experiment("seeds=[0]")))
    assert "[n/a]" in said and "one seed says little" in said and "over them" not in said


def test_training_alone_and_a_task_without_a_filter(fake_experiment):
    experiment = fake_experiment("seeds=[0]", "env=InvertedPendulum-v5", "arms={unfiltered: {filter: none}}")
    said = words(run_all(experiment, evaluate=False))
    assert "There is no filter to compare with yet." in said
    assert "Violations are not judged: the task reports no cost." in said and "0 of" not in said
    assert "Training, all episodes" in said
    assert "No recorded steps with a filter on." in said
    assert "No videos. Nothing has been filmed yet" in said


def test_constraints_places_and_what_was_left_out(fake_experiment):
    experiment = fake_experiment("arms.filtered.learner={kind: adaption_penalty, penalty: 1}")
    flags = np.arange(200) % 4 == 0
    log = steps(
        intervened=flags,
        correction=flags.astype(np.float32),
        refused=np.column_stack([flags, ~flags]),
        constraint_names=np.array(["Reach<1>", "Speed"]),
        left_out=7,
    )
    fill(experiment, {"violations": 1}, {"infeasible": 1, "fallback": 1}, steps(violated=flags), log)
    said = reported(experiment)
    for expected in (
        "of 400 actions refused by Speed 75 %, Reach<1> 25 %",
        "Where violations were: unfiltered, filter off",
        "Where the filter stepped in: filtered",
        "From the first 20,000 steps of each run; 28 more were evaluated but not kept.",
        "Of 2,400 steps with it 24 steps were infeasible and 24 ran the fallback.",
        "filtered trained through the filter, learner adaption_penalty",
        "TMLR 2023: filtered adaption_penalty",
    ):
        assert expected in said, expected


def test_a_task_without_a_cost_shows_none(fake_experiment):
    experiment = fake_experiment()
    fill(experiment, JUDGES_NOTHING | {"return": 20}, JUDGES_NOTHING | {"return": 10})
    said = reported(experiment)
    assert "Violations are not judged: the task reports no cost." in said
    table = said.partition("In numbers")[2].partition("The same episode")[0]
    assert (
        table.count("not judged") == 1 + 2 * 6
    )  # the note; cost and violations of two arms in three conditions
    assert "Steps in violation, total not judged not judged" in said.partition("Every metric")[2]
    for left_out in ("cost per episode", "0 of 1,000"):
        assert left_out not in said.partition("How to read this")[0], left_out


def test_nothing_to_report_yet(fake_experiment):
    experiment = fake_experiment()
    with pytest.raises(RunStateError, match=r"Nothing to report in .* yet; run `safe-wrappers compare`"):
        write_report(experiment, summarize(experiment))
