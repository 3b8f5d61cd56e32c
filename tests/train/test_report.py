import io
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from made_up import episode, fill, steps, write_evaluation, write_training
from PIL import Image

from safe_wrappers.errors import RunStateError
from safe_wrappers.train.config import parse_experiment, read_config
from safe_wrappers.train.evaluation.evaluate import evaluate_run
from safe_wrappers.train.evaluation.metrics import METRICS, REGISTRY, absent
from safe_wrappers.train.evaluation.summary import summarize
from safe_wrappers.train.report import write_report
from safe_wrappers.train.run import Progress, train_run
from safe_wrappers.train.videos import record as videos
from safe_wrappers.train.videos.record import record_videos
from safe_wrappers.train.videos.rendering import Rendering

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

    VOID = ("meta", "link", "use", "path", "br", "img", "source")

    def __init__(self, text):
        super().__init__()
        self.tags, self.text, self._open, self._svgs = [], [], [], []
        self.feed(text)
        assert not self._open

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag == "svg":
            self._svgs.append([])
        if tag not in self.VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        if tag not in self.VOID:
            assert self._open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)
        if "svg" in self._open and data.strip():
            self._svgs[-1].append(data.strip())

    def svg_texts(self):
        """What is written in each picture."""
        return self._svgs


def words(page):
    """The page's text, spaces as one."""
    return " ".join(" ".join(page.text).split())


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """The fake experiment's page with films; trained once for all tests that only look at it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(HERE))
        patch.setattr(videos, "find_rendering", lambda env: Rendering({}))
        patch.setattr(videos, "run_jobs", lambda jobs, *_: [job.call(*job.arguments, SILENT) for job in jobs])
        overrides = [f"output={tmp_path_factory.mktemp('report')}", "env=fake_task:FilmedGoal-v0"]
        experiment = parse_experiment(read_config(HERE / "fake.yaml", overrides))
        run_all(experiment)
        record_videos(experiment, None)
        yield write_report(experiment, summarize(experiment), "safe-wrappers compare a&b.yaml")


def test_the_page_is_whole_and_asks_for_nothing_from_outside(report):
    text = report.read_text()
    page = Page(text)
    without_data = re.sub(r"data:image/webp;base64,[\w+/=]+", "data:,", text)
    assert not re.search(r"https?://|//[a-z]|@import|<script|xmlns", without_data)
    links = [attrs.get(key, "") for _, attrs in page.tags for key in ("href", "src", "srcset", "xlink:href")]
    files = {link for link in links if link and not link.startswith(("data:", "#"))}
    assert all(re.fullmatch(r"report_data/[\w-]+\.csv", link) for link in files)
    assert {report.parent / link for link in files} == set((report.parent / "report_data").iterdir())
    assert len(files) == sum(
        "role" in attrs for tag, attrs in page.tags if tag == "svg"
    )  # beside every picture
    ids = [attrs["id"] for _, attrs in page.tags if "id" in attrs]
    assert len(ids) == len(set(ids))
    assert {link[1:] for link in links if link.startswith("#")} <= set(ids)
    assert set(re.findall(r"url\(#([^)]+)\)", text)) <= set(ids)
    assert set(re.findall(r"var\((--[\w-]+)\)", text)) <= set(re.findall(r"(--[\w-]+):", text))
    assert not re.search(r"#0[0-9a]0[0-9a]0[0-9a]", text)  # no placeholder colour is left
    assert "prefers-color-scheme: dark" in text


def test_every_picture_has_words_for_those_who_cannot_see_it(report):
    page = Page(report.read_text())
    labels = [attrs["aria-label"] for tag, attrs in page.tags if tag == "svg"]
    alts = [attrs["alt"] for tag, attrs in page.tags if tag == "img"]
    assert len(labels) >= 9
    assert len(alts) == 4
    assert all(len(text) > 30 and text.endswith((".", ". ")) for text in labels + alts)
    assert len(set(labels + alts)) == len(labels + alts)


def test_the_numbers_of_every_table_are_explained(report):
    page = Page(report.read_text())
    linked = {
        attrs["href"].removeprefix("#number-") for tag, attrs in page.tags if attrs.get("class") == "number"
    }
    entries = {
        attrs["id"].removeprefix("number-") for _, attrs in page.tags if "number-" in attrs.get("id", "")
    }
    assert linked == entries  # none is missing, and none is told that is not shown
    assert {"arm", "steps", "return", "cost", "violations", "intervention_rate", "elapsed_s"} <= linked
    said = words(page).partition("What each number is")[2]
    for name in linked:
        assert REGISTRY[name].label in said and REGISTRY[name].counts in said
        assert "".join(absent(name).replace("`", "").split()) in "".join(said.split()), name
    headings = [attrs for tag, attrs in page.tags if tag == "th" and attrs.get("scope") == "col"]
    unexplained = len(headings) - report.read_text().count('<th scope="col"><a class="number"')
    assert unexplained == 2 + 2  # package and version; the arms' names above every metric


def test_only_what_every_episode_has_is_never_absent():
    assert {name for name in METRICS if not absent(name)} == {"return", "length"}
    assert absent("infeasible_per_1000") == "No filter is on: nothing reports `cbf/infeasible`."
    assert absent("lease_expired") == "There is no lease: nothing reports `lease/expired`."
    assert absent("collisions") == "Nothing reports `collisions`."


def test_run_by_run(fake_experiment):
    experiment = fake_experiment()
    fill(experiment, {"violations": 5, "return": 20, "cost": 7}, {"return": 10, "intervention_rate": 0.25})
    (experiment.run_folder(experiment.arms[1], 1) / "finished.json").unlink()
    facts = {"timesteps": 100, "elapsed_s": 3725.4, "steps_per_s": 27.0, "filter_time_us": None}
    (experiment.run_folder(experiment.arms[0], 0) / "finished.json").write_text(json.dumps(facts))
    said = words(Page(write_report(experiment, summarize(experiment)).read_text()))
    table = said.partition("Run by run")[2]
    assert "unfiltered 0 1,000 10 20 7 50 - - 1:02:05 27 -" in table
    assert "filtered 0 1,000 10 10 0 0 25 % 0 - - 50" in table
    assert "filtered 1 1,000 10 10 0 0 25 % 0 - - -" in table
    assert (
        "Training only: all episodes of each run, with what the policy was at the time. Not finished: 1 of 4."
        in table
    )


def test_a_run_that_nobody_judged_has_no_violations(fake_experiment):
    experiment = fake_experiment("seeds=[0]")
    silent = steps(cost=steps().cost * float("nan"))
    fill(experiment, {"return": 20}, {"return": 10}, silent, silent)
    table = words(Page(write_report(experiment, summarize(experiment)).read_text())).partition("Run by run")[
        2
    ]
    assert "unfiltered 0 1,000 10 20 not judged not judged - -" in table


def test_what_the_page_says(report):
    said = words(Page(report.read_text()))
    for expected in (
        "PPO on fake_task:FilmedGoal-v0, 512 steps, 2 seeds; evaluation on 3 episodes",
        "Steps in violation",
        "With the filter on, films show what it knows",
        "with the filter, of 1,080 of training and evaluation",
        "Trained without the filter, filter on",
        "return per episode range",
        "mean over 2 seeds [their range, not an interval]",
        "Steps changed",
        "trained through the filter",
        "The same episode, filter off and on",
        "policies of training seed 0: ",
        "unfiltered, filter off",
        "changed. Shown 2.0 times slower than real.",
        "filtered, filter on, from above",
        "“unfiltered”: putting the filter on took the cost",
        "How large the corrections were",
        "Which constraint refused",
        "This filter does not say which of its constraints refused an action.",
        "When in an episode it stepped in",
        "Infeasible and fallback steps while training None: in 960 training steps",
        "Faint lines are seeds, the band is the range over them.",
        "not from the executed one (“naive”, by the names of Krasowski et al., TMLR 2023)",
        "safe-wrappers compare a&b.yaml",
        "stable-baselines3",
        "learning_rate: 0.001",
        "Evaluation, filter on",
        "Cost in substeps / episode",
    ):
        assert expected in said, expected
    order = [
        said.index(part)
        for part in ("Steps in violation", "In numbers", "The same episode", "How it was made")
    ]
    assert order == sorted(order)


def test_one_seed_no_interval(fake_experiment):
    text = run_all(fake_experiment("seeds=[0]")).read_text()
    assert "[n/a]" in text
    assert "one seed says little" in text
    assert "over them" not in text


def test_training_alone_and_a_task_without_a_filter(fake_experiment):
    experiment = fake_experiment("seeds=[0]", "env=InvertedPendulum-v5", "arms={unfiltered: {filter: none}}")
    said = words(Page(run_all(experiment, evaluate=False).read_text()))
    assert "There is no filter to compare with yet. unfiltered: return" in said
    assert "Violations are not judged: the task reports no cost." in said and "0 of" not in said
    assert "Training, all episodes" in said
    assert "No recorded steps with a filter on." in said
    assert "No videos. Nothing has been filmed yet" in said
    assert "Nothing has been evaluated yet" in said


def test_a_folder_of_an_earlier_version_still_has_its_report(fake_experiment):
    experiment = fake_experiment()
    fill(
        experiment, {"violations": 5, "return": 20}, {"return": 10}
    )  # no recorded steps, no films, no scenes
    page = Page(write_report(experiment, summarize(experiment)).read_text())
    said = words(page)
    assert "none of 2,400 steps was in violation" in said
    assert "No recorded steps with a filter on. Run safe-wrappers evaluate (again)" in said
    assert "No videos. Nothing has been filmed yet" in said
    assert "How large the corrections were" not in said
    assert len(page.svg_texts()) == 7  # the plane, three finals, three learning curves


def test_infeasible_steps_constraints_and_what_was_left_out(fake_experiment):
    experiment = fake_experiment("arms.filtered.learner={kind: adaption_penalty, penalty: 1}")
    flags = np.arange(200) % 4 == 0
    log = steps(
        intervened=flags,
        infeasible=flags,
        correction=flags.astype(np.float32),
        refused=np.column_stack([flags, ~flags]),
        constraint_names=np.array(["Reach<1>", "Speed"]),
        left_out=7,
    )
    fill(experiment, {"violations": 1}, {"infeasible": 1, "fallback": 1}, steps(violated=flags), log)
    said = words(Page(write_report(experiment, summarize(experiment)).read_text()))
    for expected in (
        "of 400 actions refused by Speed 75 %, Reach<1> 25 %",
        "of 400 steps 100 were changed",
        "of 400 steps 100 were infeasible and 0 ran the fallback",
        "Where violations were: unfiltered, filter off",
        "Where the filter stepped in: filtered",
        "The two coordinates are those",
        "From the first 10,000 steps of each run; 28 more were evaluated but not kept.",
        "Of 2,000 training steps 20 were infeasible and 20 ran the fallback.",
        "filtered trained through the filter, learner adaption_penalty",
        "TMLR 2023: filtered adaption_penalty. Returns never hold a penalty.",
    ):
        assert expected in said, expected


def test_a_task_without_a_cost_shows_none(fake_experiment):
    experiment = fake_experiment()
    silent = steps(cost=steps().cost * float("nan"))
    fill(experiment, {"return": 20}, {"return": 10}, silent, silent)
    said = words(Page(write_report(experiment, summarize(experiment)).read_text()))
    assert "Violations are not judged: the task reports no cost." in said
    table = said.partition("In numbers")[2].partition("The same episode")[0]
    assert (
        table.count("not judged") == 1 + 2 * 6
    )  # the note; cost and violations of two arms in three conditions
    assert "Steps in violation, total not judged not judged" in said.partition("How it was made")[2]
    for left_out in ("Return against cost", "Cost of the trained policies", "cost per episode", "0 of 1,000"):
        assert left_out not in said.partition("How to read this")[0], left_out


def test_arms_of_several_tasks_are_reported_without_being_mixed_up(fake_experiment):
    experiment = fake_experiment("seeds=[0]", "arms.filtered.env=Pendulum-v1", "arms.filtered.total_steps=64")
    for arm, names in ((0, ["x (m)", "y (m)", "z (m)"]), (1, ["a", "b", "c"])):
        flags = np.arange(200) % 2 == 0
        log = steps(intervened=flags, coordinate_names=np.array(names), constraint_names=np.array([names[0]]))
        write_training(experiment, arm, 0, [episode(timesteps=100)])
        for condition in ("filter_off", "filter_on"):
            write_evaluation(experiment, arm, 0, condition, [episode()] * 2, log)
    said = words(Page(write_report(experiment, summarize(experiment)).read_text()))
    assert "PPO on fake_task:FakeGoal-v0, PPO on Pendulum-v1, 64 to 512 steps" in said
    assert "The same policies, “filtered”, with the filter on and off." in said


def test_settings_are_escaped(fake_experiment):
    experiment = fake_experiment("seeds=[0]", "arms.filtered.filter.kwargs.name=<script>&")
    write_training(experiment, 0, 0, [episode(timesteps=1)])
    text = write_report(experiment, summarize(experiment), "<script>x</script>").read_text()
    assert "<script>" not in text
    assert "&lt;script&gt;&amp;" in text


def test_nothing_to_report_yet(fake_experiment):
    experiment = fake_experiment()
    with pytest.raises(RunStateError, match=r"Nothing to report in .* yet; run `safe-wrappers compare`"):
        write_report(experiment, summarize(experiment))


def browse(tmp_path, *more):
    flags = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking")
    return subprocess.run(
        [
            CHROMIUM,
            *flags,
            f"--user-data-dir={tmp_path / 'profile'}",
            "--enable-logging=stderr",
            "--v=0",
            *more,
        ],
        capture_output=True,
        text=True,
        timeout=60,
    )


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on PATH: the report is not opened in a browser")
def test_a_browser_draws_it_without_an_error(report, tmp_path):
    done = browse(tmp_path, "--dump-dom", report.as_uri())
    assert done.returncode == 0
    assert "CONSOLE" not in done.stderr
    assert done.stdout.count("<svg ") == report.read_text().count("<svg ")
    page = Page(done.stdout[done.stdout.index("<html") :])
    assert "Evaluation, filter on" in " ".join(page.text)
    # The browser's parser moved nothing out of its place: all of the pictures' paths are inside them.
    assert done.stdout.count("<path ") == report.read_text().count("<path ")


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on PATH: the report is not opened in a browser")
def test_the_page_follows_the_systems_scheme(report, tmp_path):
    brightness = []
    for scheme in (0, 1):  # dark, light
        shot = tmp_path / f"{scheme}.png"
        picture = f"--screenshot={shot}"
        browse(
            tmp_path,
            f"--blink-settings=preferredColorScheme={scheme}",
            "--window-size=800,600",
            picture,
            report.as_uri(),
        )
        brightness.append(np.asarray(Image.open(io.BytesIO(shot.read_bytes())).convert("L")).mean())
    assert brightness[0] < 60 < 200 < brightness[1]
