"""`python -m benchmarks.endurance` attacks in chunks, counts what the judges see, and goes on where it was killed."""

import dataclasses
import json
import sys

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
pytest.importorskip("gymnasium_robotics")

from benchmarks import endurance
from benchmarks.cases import CASES
from benchmarks.endurance import Chunk, attacked, plan, run
from benchmarks.endurance_report import collected, memory, speed, table
from benchmarks.searching_drivers import HORIZON, SearchingDriver, cross_entropy, differences
from benchmarks.trained_adversary import Tally

POINT, MAZE = "SafePointGoal1-v0", "PointMaze_UMaze-v3"


def counts(row):
    """What does not depend on the machine."""
    return {name: row[name] for name in (*Tally.__dataclass_fields__, "simulated")}


def test_the_judge_sees_what_a_driver_does_without_the_filter():
    on, off = (run(Chunk(POINT, "hazard-seeking", 1600, 3, filtered)) for filtered in (True, False))
    assert off["violations"] > 50 and off["smallest"] is None and off["examples"] == []
    assert on["violations"] == on["infeasible"] == on["unsafe"] == 0
    assert on["steps"] == off["steps"] == 1600
    assert 0 < on["intervened"] < 1600 and 0.0 < on["smallest"] < 0.02
    assert on["mb"] > 50.0 and on["end_mb"] > 50.0 and on["us"] > on["reference_us"] > 0.0


def test_a_chunk_follows_from_its_seed(monkeypatch):
    monkeypatch.setattr(endurance, "TOGETHER", 4)
    chunk = Chunk("SafeCarGoal1-v0", "full throttle", 40, 5)
    first, again, other = run(chunk), run(chunk), run(dataclasses.replace(chunk, seed=6))
    assert counts(first) == counts(again) != counts(other)


def test_no_two_drivers_start_alike():
    chunks = [Chunk(POINT, driver, 1, 0) for driver in ("random", "bang-bang")]
    starts = [env.unwrapped.hazard_positions for c in chunks for env in attacked(c)[0].unwrapped.envs]
    assert len(np.unique(starts, axis=0)) == len(starts) == 2 * endurance.TOGETHER


def test_steps_that_reset_an_env_are_not_judged(monkeypatch):
    # The judge of the maze would raise if a reset were between its two looks.
    monkeypatch.setitem(CASES, MAZE, dataclasses.replace(CASES[MAZE], max_episode_steps=40))
    row = run(Chunk(MAZE, "corner-seeking", 16 * 42, 0))
    assert row["steps"] == 16 * 42 and row["violations"] == 0 < row["intervened"]


class Strict:
    """A judge that is never content."""

    def before(self):
        pass

    def after(self, executed, info):
        return np.nan


def test_a_violation_is_kept_with_what_makes_it_again(monkeypatch):
    monkeypatch.setitem(CASES, POINT, dataclasses.replace(CASES[POINT], judge=lambda env: Strict()))
    row = run(Chunk(POINT, "random", 32, 7))
    assert (row["violations"], row["unflagged"]) == (32, 32)
    assert [(e["seed"], e["of"], e["after"]) for e in row["examples"][14:18]] == [
        (7, 14, 0), (7, 15, 0), (7, 0, 16), (7, 1, 16)
    ]  # fmt: skip
    assert np.shape(row["examples"][0]["executed"]) == (2,)


@pytest.mark.parametrize("search", [cross_entropy, differences])
def test_searches_go_down(search):
    target = np.linspace(-0.8, 0.8, 12).reshape(6, 2)

    def score(knots):
        assert (np.abs(knots) <= 1.0 + 0.25).all()  # but for the differences' nudges
        return float(((knots - target) ** 2).sum())

    rng = np.random.default_rng(0)
    start = rng.uniform(-1.0, 1.0, target.shape)
    knots, first = start, score(start)
    for _ in range(12):
        knots = search(score, knots, rng)
    assert score(knots) < 0.4 * first


@pytest.mark.parametrize("search", [cross_entropy, differences])
def test_what_was_simulated_is_what_happens(search):
    case = CASES["SafePointGoal2-v0"]
    env = case.protect(case.make())
    env.reset(seed=2)
    found = []
    driver = SearchingDriver(env, np.random.default_rng(1), lambda score, knots, rng: found[0])
    scores = []
    for knots in np.random.default_rng(0).uniform(-1.0, 1.0, (8, 6, 2)):
        found[:] = [knots]
        scores.append(driver._score(knots))
    knots = search(driver._score, np.zeros((6, 2)), np.random.default_rng(0))
    best = driver._score(knots)
    assert best < min(scores) and driver.simulated % HORIZON == 0
    margins = [env.step(action)[4]["cbf/margin"] for action in driver._actions(knots)]
    assert min(margins) == best  # nothing of the env was moved, and the copy did what the env does


def test_an_episode_of_its_own_for_every_search():
    row = run(Chunk(POINT, "CEM", 20, 0))
    assert row["steps"] == 20 and row["simulated"] == 2 * 36 * HORIZON and row["violations"] == 0


def test_a_longer_plan_begins_with_the_shorter():
    short, long = plan(1_000_000), plan(5_000_000)
    assert long[: len(short)] == short and len(set(long)) == len(long)
    filtered = [c for c in long if c.filtered]
    assert 5_000_000 <= sum(c.planned for c in filtered) < 5_050_000
    for env in endurance.ENVS:
        drivers = {*endurance.hand_written(env), "learner", "CEM", "differences"}
        assert {c.driver for c in filtered if c.env == env} == drivers
        assert {c.driver for c in long if c.env == env and not c.filtered} == {*endurance.hand_written(env)}


def of(env, driver, at, filtered=True, process="1", **more):
    """A row of the file, as if it had been measured."""
    tally = dataclasses.asdict(Tally(steps=1000, intervened=100, smallest=0.004 if filtered else None))
    row = dataclasses.asdict(Chunk(env, driver, 1000, at, filtered)) | tally
    row |= {"process": process, "versions": "a", "mb": 500.0, "us": 100.0, "ratio": 50.0, "simulated": 0}
    return row | {"simulated_violations": 0} | more


def test_memory_is_judged_after_the_first_round():
    flat = [of(POINT, "random", at, mb=500.0 + (-1) ** at) for at in range(40)]
    assert memory(flat[:3]) is None
    found = memory([of(POINT, "random", 0, mb=100.0), *flat])
    assert found["chunks"] == 40 and abs(found["growth"]) < 0.001
    assert (found["least_mb"], found["most_mb"]) == (499.0, 501.0)
    leaking = memory([of(POINT, "random", at, mb=500.0 + at) for at in range(41)])
    assert leaking["growth"] == pytest.approx(39.0 / 520.5) and leaking["steps"] == 39_000


def test_a_drift_of_the_speed_is_found_under_drivers_of_all_speeds():
    rng = np.random.default_rng(0)

    def rows(per_million):
        found = []
        for at in range(400):
            driver, ratio = [("random", 50.0), ("bang-bang", 90.0), ("goal-seeking", 70.0)][at % 3]
            drift = per_million * at / 1000 + rng.normal(0.0, 0.02)
            found.append(of(POINT, driver, at, ratio=ratio * np.exp(drift)))
        return found

    still, slower = speed(rows(0.0)), speed(rows(0.5))
    assert abs(still["per_million"]) < 3.0 * still["error"] < 0.05
    assert slower["per_million"] == pytest.approx(0.5, abs=3.0 * slower["error"])
    assert slower["chunks"] == 397  # but for each driver's first
    assert speed(rows(0.0)[:4]) is None


def test_the_table_says_what_no_violation_bounds():
    rows = [of(POINT, "random", at) for at in range(3)] + [of(POINT, "random", 0, False, violations=40)]
    rows += [of(MAZE, "CEM", 0, violations=1, unflagged=1, examples=[{"seed": 0}], simulated=360)]
    text = table(collected(rows))
    assert f"| {POINT} | random | 3,000 | 0 | 40 | 10.0% | 0 | 0 | 0 | 4.000 | 100 | - |" in text
    assert f"| {MAZE} | CEM | 1,000 | 1 | - | 10.0% | 0 | 0 | 0 | 4.000 | 100 | 360 |" in text
    assert f"| {POINT} | 3,000 | 0 | 1.0e-03 a step | 4.000 |" in text
    assert "| all | 4,000 | 1 | - | 4.000 |" in text
    assert collected(rows)["drivers"][1]["examples"] == [{"seed": 0}]


@pytest.fixture
def few(monkeypatch, tmp_path, capsys):
    """The command on one env and short chunks; the learner counts, and does not train."""

    def learn(chunk):
        return dataclasses.asdict(Tally(steps=60, smallest=0.1)) | {"off_steps": 10, "off_violations": 5}

    monkeypatch.setattr(endurance, "ENVS", (POINT,))
    monkeypatch.setattr(endurance, "STEPS", {"hand": 32, "off": 16, "search": 10, "learner": 60})
    monkeypatch.setattr(endurance, "learn", learn)
    monkeypatch.setattr(endurance, "used_mb", lambda: 100.0)  # collects garbage three times a chunk

    def command(*words):
        folder = ["--folder", str(tmp_path / "chunks"), "--results", str(tmp_path)]
        monkeypatch.setattr(sys, "argv", ["endurance", *folder, *words])
        endurance.main()
        return capsys.readouterr().out

    return command


def test_a_killed_run_goes_on(few, monkeypatch, tmp_path):
    whole = few("--steps", "230")
    path = tmp_path / "chunks" / "endurance.jsonl"
    lines = path.read_text().splitlines(keepends=True)
    assert len(lines) == 5 + 5 + 1 + 1  # off, on, learner, one search
    path.write_text("".join(lines[:7]) + lines[7][:40])  # killed while it wrote the eighth
    ran = []
    monkeypatch.setattr(endurance, "run", lambda chunk: ran.append(chunk) or run(chunk))
    few("--steps", "230")
    again = path.read_text().splitlines(keepends=True)
    assert again[:7] == lines[:7] and len(ran) == len(lines) - 7
    assert [counts({"simulated": 0} | json.loads(line)) for line in again] == [
        counts({"simulated": 0} | json.loads(line)) for line in lines
    ]
    few("--steps", "10")  # less than there is: nothing is run, nothing is lost
    assert len(ran) == len(lines) - 7 and path.read_text().splitlines(keepends=True) == again
    collected_alone = few("--collect")
    assert (tmp_path / "endurance.md").read_text() == collected_alone
    drivers = json.loads((tmp_path / "endurance.json").read_text())["drivers"]
    assert {d["driver"]: d["off_steps"] for d in drivers}["learner"] == 10
    assert [line.split("|")[2:5] for line in whole.splitlines() if POINT in line] == [
        line.split("|")[2:5] for line in collected_alone.splitlines() if POINT in line
    ]


def test_nothing_to_collect_says_where_it_looked(few, capsys):
    with pytest.raises(SystemExit):
        few("--collect")
    assert "endurance.jsonl" in capsys.readouterr().err
