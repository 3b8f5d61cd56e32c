"""The whole-body benchmark in small: its judge on a ball whose forces are known, and short runs of its arms."""

import json
import math

import gymnasium as gym
import mujoco
import numpy as np
import pytest

from benchmarks import whole_body as benchmark
from benchmarks.whole_body import ARMS, HEADER, SHARE, Judge, Row, answer_lines, ask_programs, drive, line

BALL = """<mujoco><option timestep="0.005"/><default><geom friction="0.8 0 0"/></default>
<worldbody><geom type="plane" size="9 9 1"/>
<body pos="0 0 {height}"><joint name="x" type="slide" axis="1 0 0" range="-2 2"/>
<joint type="slide" axis="0 0 1"/><geom size=".1" mass="2"/></body></worldbody>
<actuator><motor joint="x" gear="50" ctrllimited="true" ctrlrange="-1 1"/></actuator></mujoco>"""
WEIGHT = 2.0 * 9.81


class Ball(gym.Env):
    """A ball of 2 kg that slides and does not roll, on a friction of 0.8."""

    def __init__(self, height=0.1):
        self.model = mujoco.MjModel.from_xml_string(BALL.format(height=height))
        self.data = mujoco.MjData(self.model)

    def step(self, action):
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, 5)


@pytest.mark.parametrize(
    ("part", "share", "left", "by_tolerance", "unflagged"),
    [
        (0.68, SHARE, 0, 0, 0),
        (0.705, SHARE, 1, 0, 0),  # by 0.4 % of the weight
        (0.75, SHARE, 1, 1, 1),  # by 4 %
        (0.75, 0.9, 1, 1, 0),
        (0.95, 0.9, 1, 1, 1),
    ],
)
@pytest.mark.parametrize("flagged", [False, True])
def test_the_judge_counts_steps_that_leave_the_cone(part, share, left, by_tolerance, unflagged, flagged):
    env, row = Ball(), Row("Ball", "pushed")
    judge = Judge(env, share)
    push = part * 0.8 * WEIGHT / 50.0
    for _ in range(40):
        env.step(push)
    judge.before()
    env.step(push)
    judge.after(row, flagged)
    assert (row.left_cone, row.left_cone_by_tolerance) == (left, by_tolerance)
    assert row.unflagged == (0 if flagged else unflagged)
    assert (row.evaluations, row.polygons, row.beyond_stop) == (5, 0, 0)


def test_the_judge_sees_stops_and_no_contacts_in_the_air_and_refuses_another_machine():
    env, row = Ball(height=3.0), Row("Ball", "falls")
    judge = Judge(env)
    env.data.qpos[0] = 2.2
    judge.before()
    env.step(0.0)
    judge.after(row, False)
    assert (row.left_cone, row.evaluations, row.beyond_stop) == (0, 5, 1)
    judge.before()
    env.step(0.0)
    env.data.qvel[0] += 1.0
    with pytest.raises(RuntimeError, match="does not end where the env did"):
        judge.after(row, False)


def noisy(seed=0):
    rng = np.random.default_rng(seed)
    return lambda observation: rng.uniform(-1.0, 1.0, 6).astype(np.float32)


@pytest.mark.parametrize(
    "arm", ["no filter", "program, pyramids", "forecast, contacts alone", "forecast, share 0.9"]
)
def test_arms_differ_as_they_should(arm):
    row = drive("HalfCheetah", arm, noisy(), 1, 30)
    assert (row.steps, row.episodes, row.evaluations) == (30, 1, 150)
    assert row.seconds == pytest.approx(30 * 0.05)
    assert row.left_cone >= row.left_cone_by_tolerance
    if arm == "no filter":
        assert row.left_cone_by_tolerance > 5 and row.changed == 0 and not row.decision_ms
        assert row.unflagged == row.left_cone_by_tolerance
    else:
        assert row.changed > 3 and len(row.decision_ms) == 30 and row.correction > 0.0
    if arm.startswith("forecast"):
        assert row.unflagged == 0
    cells = line(row).split("|")
    assert len(cells) == len(HEADER.splitlines()[0].split("|"))
    assert cells[9].strip() == ("-" if arm == "no filter" else str(row.unflagged))


def test_every_arm_is_named_and_makes_an_env():
    for name, wrap in ARMS.items():
        env = wrap(gym.make("Ant-v5"))
        assert (env.unwrapped is not env) and name
        env.close()
    assert set(benchmark.OWN_SHARE) <= set(ARMS)


def test_the_programs_are_asked_where_the_forecast_refuses():
    answers = ask_programs("HalfCheetah", noisy(), 1, 25)
    assert answers.refused > 3
    assert set(answers.corrections) == {"pyramids", "exact cones"}
    for name, distances in answers.corrections.items():
        assert len(distances) == answers.refused and all(math.isfinite(d) for d in distances)
        assert 0 <= answers.admitted.get(name, 0) <= answers.refused
    # Pyramids are inside the cones: their answer is no closer, but for the price of forces.
    nearer = np.array(answers.corrections["pyramids"]) - np.array(answers.corrections["exact cones"])
    assert (nearer > -0.02).mean() > 0.9
    assert len(answer_lines(answers)) == 2


def test_it_writes_tables(tmp_path, monkeypatch, capsys):
    rng = np.random.default_rng(0)
    monkeypatch.setattr(
        benchmark, "learned", lambda robot: lambda o: rng.uniform(-1, 1, 8).astype(np.float32)
    )
    arguments = [
        "--robots",
        "Ant",
        "--arms",
        "no filter",
        "program, pyramids",
        "--episodes",
        "1",
        "--limit",
        "4",
    ]
    monkeypatch.setattr("sys.argv", ["whole_body", *arguments, "--results", str(tmp_path)])
    benchmark.main()
    text = (tmp_path / "whole_body.md").read_text()
    assert "1 episodes of at most 4 steps" in text and "| Ant | no filter |" in text
    rows = [json.loads(each) for each in (tmp_path / "whole_body.jsonl").read_text().splitlines()]
    assert [row["arm"] for row in rows] == ["no filter", "program, pyramids"]
    assert rows[0]["decision_ms"] is None and len(rows[1]["decision_ms"]) == 2
    assert "| Ant | program, pyramids |" in capsys.readouterr().out
