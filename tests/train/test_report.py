import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import pytest

from safe_wrappers.errors import RunStateError
from safe_wrappers.train.config import parse_experiment
from safe_wrappers.train.config_file import read_config
from safe_wrappers.train.evaluate import evaluate_run
from safe_wrappers.train.report import write_report
from safe_wrappers.train.run import Progress, train_run
from safe_wrappers.train.run_callbacks import EPISODE_COLUMNS
from safe_wrappers.train.summary import summarize
from safe_wrappers.train.tables import write_rows

HERE = Path(__file__).parent
CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None
)
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

    VOID = ("meta", "link", "use", "path", "br")

    def __init__(self, text):
        super().__init__()
        self.tags, self.text, self._open = [], [], []
        self.feed(text)
        assert not self._open

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        if tag not in self.VOID:
            assert self._open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """The fake experiment's page; trained once for all tests that only look at it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(HERE))
        output = tmp_path_factory.mktemp("report")
        yield run_all(parse_experiment(read_config(HERE / "fake.yaml", [f"output={output}"])))


def test_the_page_is_whole_and_asks_for_nothing_from_outside(report):
    text = report.read_text()
    page = Page(text)
    assert not re.search(r"https?://|//[a-z]|@import|<script|<img|xmlns", text)
    links = [attrs.get(key, "") for _, attrs in page.tags for key in ("href", "src", "xlink:href")]
    assert all(link == "data:," or link.startswith("#") for link in links if link)
    ids = [attrs["id"] for _, attrs in page.tags if "id" in attrs]
    assert len(ids) == len(set(ids))
    assert {link[1:] for link in links if link.startswith("#")} <= set(ids)
    assert set(re.findall(r"url\(#([^)]+)\)", text)) <= set(ids)
    assert set(re.findall(r"var\((--\w+)\)", text)) <= set(re.findall(r"(--\w+):", text))
    assert not re.search(r"#0[0-9a]0[0-9a]0[0-9a]", text)  # no placeholder colour is left
    assert "prefers-color-scheme: dark" in text


def test_what_the_page_says(report):
    words = " ".join(" ".join(Page(report.read_text()).text).split())
    for expected in (
        "PPO on fake_task:FakeGoal-v0, 512 steps, 2 seeds; evaluation on 3 episodes",
        "Steps with a violation while training",
        "in 960 steps with the filter",
        "Return per evaluation episode",
        "Steps changed by the filter",
        "The same episode, without and with the filter",
        "of the 3 evaluation episodes the one in which unfiltered had most violations",
        "Evaluation, filter on",
        "Cost in substeps / episode",
        "The band is the bootstrap 95 % interval over seeds.",
        "“naive” in Krasowski et al., TMLR 2023",
        "learning_rate: 0.001",
    ):
        assert expected in words


def test_one_seed_no_interval(fake_experiment):
    text = run_all(fake_experiment("seeds=[0]")).read_text()
    assert "[n/a]" in text
    assert "The band is" not in text


def test_training_alone_and_a_task_without_positions(fake_experiment):
    experiment = fake_experiment("seeds=[0]", "env=InvertedPendulum-v5", "arms={unfiltered: {filter: none}}")
    text = run_all(experiment, evaluate=False).read_text()
    assert "No picture: it needs an evaluation with and without a filter" in text
    assert "Steps with a violation while training" not in text  # nothing to compare with
    assert "Training, all episodes" in text


def test_settings_are_escaped(fake_experiment):
    experiment = fake_experiment("seeds=[0]", "arms.filtered.filter.kwargs.name=<script>&")
    row = dict.fromkeys(EPISODE_COLUMNS, 1.0)
    write_rows(experiment.run_folder(experiment.arms[0], 0) / "episodes.csv", EPISODE_COLUMNS, [row])
    text = write_report(experiment, summarize(experiment)).read_text()
    assert "<script>" not in text
    assert "&lt;script&gt;&amp;" in text


def test_nothing_to_report_yet(fake_experiment):
    experiment = fake_experiment()
    with pytest.raises(RunStateError, match=r"Nothing to report in .* yet; run `safe-wrappers compare`"):
        write_report(experiment, summarize(experiment))


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on PATH: the report is not opened in a browser")
def test_a_browser_draws_it_without_an_error(report, tmp_path):
    flags = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking")
    done = subprocess.run(
        [
            CHROMIUM,
            *flags,
            f"--user-data-dir={tmp_path / 'profile'}",
            "--enable-logging=stderr",
            "--v=0",
            "--dump-dom",
            report.as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0
    assert "CONSOLE" not in done.stderr
    assert done.stdout.count("<svg ") == 2
    page = Page(done.stdout[done.stdout.index("<html") :])
    assert "Evaluation, filter on" in " ".join(page.text)
    # The browser's parser moved nothing out of its place: all of the pictures' paths are inside them.
    assert done.stdout.count("<path ") == report.read_text().count("<path ")
