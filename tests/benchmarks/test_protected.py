"""`python -m benchmarks.protected` counts what the judge says, prints a table, goes on where it was killed."""

import dataclasses
import json
import sys

import numpy as np
import pytest

from benchmarks import protected
from benchmarks.cases import CASES
from benchmarks.protected import Job, run


def command(monkeypatch, capsys, folder, *words):
    monkeypatch.setattr(sys, "argv", ["protected", "--workers", "1", "--results", str(folder), *words])
    protected.main()
    return capsys.readouterr().out


def cells(table):
    return [
        [c.strip() for c in line.strip("|").split("|")] for line in table.splitlines() if line.startswith("|")
    ]


def test_the_command_prints_a_row_per_env(monkeypatch, capsys, tmp_path):
    out = command(monkeypatch, capsys, tmp_path, "--steps", "50", "--envs", "Reacher", "Swimmer")
    head, _, *rows = cells(out)
    assert [row[0] for row in rows] == ["Reacher-v5", "SafeSwimmerVelocity-v0, Swimmer-v5"]
    assert all(len(row) == len(head) for row in rows)
    at = head.index
    assert [row[at("steps each")] for row in rows] == ["48", "48"]  # four and three drivers
    assert rows[0][at("violations on")] == "0" and int(rows[0][at("off")]) > 20
    assert (tmp_path / "protected.md").read_text() == out


def test_the_command_prints_a_row_per_driver(monkeypatch, capsys, tmp_path):
    words = ("--hard", "--steps", "50", "--envs", "with a disc", "--drivers", "pulse", "disc-seeking")
    out = command(monkeypatch, capsys, tmp_path, *words)
    _, _, *rows = cells(out)
    assert [row[1:4] for row in rows] == [
        [d, f, "25"] for f in ("on", "off") for d in ("pulse", "disc-seeking")
    ]
    assert [row[4] for row in rows[:2]] == ["0", "0"] and all(int(row[4]) > 10 for row in rows[2:])


def test_off_leaves_the_filter_out(monkeypatch, capsys, tmp_path):
    words = ("--off", "--steps", "8", "--seed", "3", "--envs", "Reacher")
    head, _, row = cells(command(monkeypatch, capsys, tmp_path, *words))
    assert row[head.index("violations on")] == "-" and row[head.index("off")].isdigit()
    rows = [json.loads(line) for line in (tmp_path / "protected.jsonl").read_text().splitlines()]
    assert len(rows) == 4 and all(r["seed"] == 3 and not r["filtered"] for r in rows)


def test_nothing_to_run_names_the_envs(monkeypatch, capsys, tmp_path):
    with pytest.raises(SystemExit):
        command(monkeypatch, capsys, tmp_path, "--envs", "Recher")
    assert "Reacher-v5" in capsys.readouterr().err


def test_a_killed_run_goes_on(monkeypatch, capsys, tmp_path):
    words = ("--steps", "8", "--envs", "Reacher")
    whole = command(monkeypatch, capsys, tmp_path, *words)
    path = tmp_path / "protected.jsonl"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:5]) + lines[5][:40])  # killed while it wrote the sixth
    ran = []
    monkeypatch.setattr(protected, "run", lambda job: ran.append(job) or run(job))
    again = command(monkeypatch, capsys, tmp_path, *words, "--resume")
    assert len(ran) == len(lines) - 5
    assert path.read_text().splitlines(keepends=True)[:5] == lines[:5]
    assert len(path.read_text().splitlines()) == len(lines)
    untimed = [row[:4] + row[5:] for row in cells(again)]
    assert untimed == [row[:4] + row[5:] for row in cells(whole)]


def test_without_resume_it_starts_anew(monkeypatch, capsys, tmp_path):
    words = ("--off", "--steps", "4", "--envs", "Reacher")
    command(monkeypatch, capsys, tmp_path, *words)
    ran = []
    monkeypatch.setattr(protected, "run", lambda job: ran.append(job) or run(job))
    command(monkeypatch, capsys, tmp_path, *words)
    assert len(ran) == 4


def test_chunks_cover_all_steps_with_seeds_of_their_own(monkeypatch):
    arguments = dataclasses.make_dataclass("A", ["steps", "seed", "envs", "drivers", "off"])
    found = protected.jobs(CASES, arguments(100_000, 7, ["Reacher-v5"], ["pulse"], True))
    found = [job for job in found if job.case == "Reacher-v5"]
    assert sum(job.steps for job in found) == 100_000
    assert [job.seed for job in found] == list(range(7, 17))


class Strict:
    """A judge that is never content, or that knows no number."""

    def __init__(self, says, starts=()):
        self.says, self.starts = says, list(starts)

    def start(self):
        return self.starts.pop(0) if self.starts else -1.0

    def before(self):
        pass

    def after(self, executed, info):
        return self.says


@pytest.mark.parametrize("says, count", [(1.0, 30), (0.0, 0), (-1.0, 0), (np.nan, 30)])
def test_what_the_judge_says_is_counted(monkeypatch, says, count):
    case = dataclasses.replace(CASES["Reacher-v5"], judge=lambda env: Strict(says))
    monkeypatch.setitem(CASES, "Reacher-v5", case)
    row = run(Job("Reacher-v5", "random", True, 30, 0))
    # The filter has no reason to flag any of these steps.
    assert (row["violations"], row["unflagged"], row["infeasible"], row["unsafe"]) == (count, count, 0, 0)


def test_unsafe_starts_are_left_out_and_counted(monkeypatch):
    case = dataclasses.replace(CASES["Reacher-v5"], judge=lambda env: Strict(-1.0, [0.5, np.nan, -0.1]))
    monkeypatch.setitem(CASES, "Reacher-v5", case)
    assert run(Job("Reacher-v5", "random", False, 5, 0))["unsafe_starts"] == 2


def test_a_violation_that_was_flagged_is_not_unflagged(monkeypatch):
    plain = CASES["Reacher-v5"]
    flagged = dataclasses.replace(
        plain, protect=lambda env: Flagged(plain.protect(env)), judge=lambda env: Strict(1.0)
    )
    monkeypatch.setitem(CASES, "Reacher-v5", flagged)
    row = run(Job("Reacher-v5", "random", True, 30, 0))
    assert row["violations"] == 30 and row["unflagged"] == 20


class Flagged:
    """Adds one flag after another to every third step's info."""

    def __init__(self, env):
        self.env, self.steps = env, 0
        self.unwrapped, self.action_space, self.reset = env.unwrapped, env.action_space, env.reset

    def step(self, action):
        *rest, info = self.env.step(action)
        if self.steps % 3 == 0:
            info[("cbf/infeasible", "cbf/fallback", "cbf/unsafe")[self.steps // 3 % 3]] = True
        self.steps += 1
        return *rest, info


def test_an_episode_goes_on_after_the_fall_only_where_it_should():
    # A pole falls within about ten steps; every reset puts the cart back to the middle of its rail.
    plain = run(Job("InvertedPendulum-v5", "end-seeking", False, 400, 0))
    on = run(Job("InvertedPendulum-v5, on after the fall", "end-seeking", False, 400, 0))
    assert plain["violations"] == 0 and on["violations"] > 100


@pytest.mark.parametrize("name, driver", [
    ("InvertedPendulum-v5, on after the fall", "end-seeking"),
    ("InvertedPendulum-v5, on after the fall", "carrying"),
    ("Reacher-v5, with a disc", "disc-seeking"),
    ("PointMaze_UMaze-v3", "wall-seeking"),
])  # fmt: skip
def test_the_filter_keeps_what_the_driver_breaks_without_it(name, driver):
    if "Maze" in name:
        pytest.importorskip("gymnasium_robotics")
    on, off = (run(Job(name, driver, filtered, 400, 0)) for filtered in (True, False))
    assert off["violations"] > 100
    assert on["violations"] == on["unflagged"] == 0
    assert on["worst"] < 0.0 < off["worst"]
    assert on["inactive_timed"] + on["active_timed"] == 400 and on["active_ratio"] > 1.0
