import os
from pathlib import Path
from urllib.parse import unquote

import pytest
from made_up import fill, steps
from test_report import Page, words

from safe_wrappers.errors import RunStateError
from safe_wrappers.train.cli import main
from safe_wrappers.train.evaluation.summary import summarize
from safe_wrappers.train.report import write_overview

FAKE = Path(__file__).parent / "fake.yaml"


@pytest.fixture
def entries(fake_experiment):
    """Two experiments of one task, and one of a task that reports no cost."""
    made = []
    for name, off, on in (
        ("short", {"violations": 5, "cost": 50, "return": 20}, {"return": 10}),
        ("long", {"violations": 5, "cost": 90, "return": 900}, {"return": 12}),
        ("silent", {"return": 3}, {"return": 2}),
    ):
        experiment = fake_experiment(f"name={name}", *(["env=Pendulum-v1"] if name == "silent" else []))
        log = steps(cost=steps().cost * float("nan")) if name == "silent" else None
        fill(experiment, off, on, log, log)
        made.append((experiment, summarize(experiment)))
    return made


def test_the_page_has_every_verdict_and_leads_to_every_page(entries, tmp_path):
    path = write_overview(entries, tmp_path / "some where" / "page.html", "safe-wrappers report a b c")
    text = path.read_text()
    page = Page(text)
    for expected in (
        "3 experiments",
        "short, long, silent",
        "the policy returned per evaluation episode 20 [20, 20] without it",
        "the policy returned per evaluation episode 900 [900, 900] without it",
        "Violations are not judged: the task reports no cost.",
        "safe-wrappers report a b c",
        "trained through the filter",
    ):
        assert expected in words(page)
    links = [attrs["href"] for tag, attrs in page.tags if tag == "a"]
    ids = {attrs["id"] for _, attrs in page.tags if "id" in attrs}
    assert {link[1:] for link in links if link[0] == "#"} == {i for i in ids if i.startswith("number-")}
    files = [link for link in links if link.endswith(".csv")]
    assert len(files) == 2  # of each plane; nothing is drawn of the task without a cost
    assert all((path.parent / file).is_file() for file in files)
    links = [link for link in links if link[0] != "#" and link not in files]
    assert len(links) == 6  # each experiment at its verdict and at its numbers
    assert not any(link.startswith("/") for link in links)
    targets = {os.path.normpath(path.parent / unquote(link)) for link in links}
    assert targets == {str(experiment.folder / "report.html") for experiment, _ in entries}
    ids = [attrs["id"] for _, attrs in page.tags if "id" in attrs]
    assert len(ids) == len(set(ids))


def test_planes_of_one_task_share_their_axes(entries, tmp_path):
    page = Page(write_overview(entries, tmp_path / "page.html").read_text())
    drawn = page.svg_texts()
    assert len(drawn) == 2  # nothing is drawn of the task without a cost
    ticks = [sorted(text for text in texts if text.lstrip("−").isdigit()) for texts in drawn]
    assert ticks[0] == ticks[1]
    assert "800" in ticks[0]  # though nothing of the first goes beyond 20
    alone = Page(write_overview(entries[:1], tmp_path / "page.html").read_text()).svg_texts()
    assert "800" not in alone[0]


def test_an_experiment_of_which_nothing_is_there(entries, fake_experiment, tmp_path):
    empty = fake_experiment("name=empty")
    with pytest.raises(RunStateError, match=r"Nothing to report in .*empty"):
        write_overview([*entries, (empty, summarize(empty))], tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()


@pytest.fixture
def configs(entries, tmp_path):
    """The config files of the experiments."""
    made = []
    for experiment, _ in entries[:2]:
        path = tmp_path / f"{experiment.name}.yaml"
        path.write_text(FAKE.read_text().replace("name: fake", f"name: {experiment.name}"))
        made.append(str(path))
    return made


@pytest.mark.slow
def test_the_command_with_several_configs(configs, tmp_path, capsys):
    page = tmp_path / "pages" / "all.html"
    command = ["report", configs[0], "--output", str(page), configs[1], f"output={tmp_path}"]
    assert main(command) == 0
    out = capsys.readouterr().out
    assert f"Report: {tmp_path / 'short' / 'report.html'}" in out
    assert f"Overview: {page}" in out
    links = [attrs["href"] for tag, attrs in Page(page.read_text()).tags if tag == "a"]
    assert links
    assert all((page.parent / link).is_file() for link in links)
    assert f"safe-wrappers report {configs[0]} {configs[1]} output={tmp_path}" in words(
        Page(page.read_text())
    )
    # Words behind an option count too, and without one the page lies beside the experiments.
    assert main(["report", configs[0], f"output={tmp_path}", configs[1]]) == 0
    assert f"Overview: {tmp_path / 'overview.html'}" in capsys.readouterr().out


def test_the_command_with_one_config(configs, tmp_path, capsys):
    page = tmp_path / "one.html"
    assert main(["report", configs[0], f"output={tmp_path}", "--output", str(page)]) == 0
    assert "Overview" not in capsys.readouterr().out
    assert f"safe-wrappers compare {configs[0]} output={tmp_path} --report" in words(Page(page.read_text()))


def test_what_the_command_refuses(configs, tmp_path, capsys):
    assert main(["report", configs[0], configs[0], f"output={tmp_path}"]) == 1
    assert "two configs name the same experiment" in capsys.readouterr().err
    for arguments, message in (
        (["report", "--output", "x.html"], "the following arguments are required"),
        (["report", "key=value"], "the following arguments are required: CONFIG.yaml"),
        (["train", *configs], "train takes one CONFIG.yaml; report takes several"),
        (
            ["compare", configs[0], "--output", "x.html"],
            "compare takes no --output; report, diagnose and enjoy do",
        ),
        (["report", configs[0], "--reprot"], "unrecognized arguments: --reprot"),
    ):
        with pytest.raises(SystemExit):
            main(arguments)
        assert message in capsys.readouterr().err
