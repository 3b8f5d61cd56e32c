"""What is shown while runs are at work, by a clock of the test's own."""

import io
import math

import pytest
from rich.console import Console

from safe_wrappers.train.processes.pace import Pace, left_text, speed_text
from safe_wrappers.train.processes.progress_display import ProgressDisplay

TOTALS = {"one": 1000, "two": 1000, "three": 2000}
LIVE = {"return": "12.3", "violations": "not judged", "changed": "4.1 %"}


class Shown:
    def __init__(self, terminal, totals=TOTALS, unit="steps", **others):
        self.now = 0.0
        self.text = io.StringIO()
        self.console = Console(file=self.text, force_terminal=terminal, width=100, color_system=None)
        self.display = ProgressDisplay("Training", unit, totals, self.console, lambda: self.now, **others)

    def lines(self):
        return self.text.getvalue().splitlines()

    def table(self):
        with self.console.capture() as capture:
            self.console.print(self.display.table())
        return [" ".join(line.split()) for line in capture.get().splitlines()]


def at_work(terminal):
    shown = Shown(terminal)
    for name in ("one", "two"):
        shown.display.start(name)
        shown.display.steps(name, 100)  # it goes on from a checkpoint: no part of the speed
    shown.now = 10.0
    shown.display.steps("one", 300)
    shown.display.steps("two", 200)
    shown.display.figures("one", LIVE)
    return shown


def test_a_terminal_has_the_total_with_its_time_and_each_run_with_its_figures():
    shown = at_work(terminal=True)
    heading, total, one, two = shown.table()
    assert heading == "steps speed left return violations changed"
    # 3,500 steps are left of all, at 20 + 10 steps/s.
    assert total.startswith("Training ") and total.endswith(" 12 % 30 steps/s 0:01:57")
    assert one.endswith("30 % 20 steps/s 0:00:35 12.3 not judged 4.1 %")
    assert two.endswith("20 % 10 steps/s 0:01:20")
    shown.display.end("one", "done")
    assert shown.lines()[-1] == "one: done, 20 steps/s"
    assert len(shown.table()) == 3


def test_a_file_gets_lines_now_and_then():
    shown = at_work(terminal=False)
    shown.display.tick()
    assert shown.lines() == ["one: started (1,000 steps)", "two: started (1,000 steps)"]
    shown.now = 30.0
    shown.display.tick()
    assert shown.lines()[2:] == [
        "Training: 12 %, 500/4,000 steps, 30 steps/s, 0:01:57 left",
        "  one: 30 %, return 12.3, violations not judged, changed 4.1 %, 20 steps/s, 0:00:35 left",
        "  two: 20 %, 10 steps/s, 0:01:20 left",
    ]
    shown.now = 59.0
    shown.display.tick()
    assert len(shown.lines()) == 5
    spoken = []
    for second in range(60, 6 * 3600):
        shown.now = float(second)
        before = len(shown.lines())
        shown.display.tick()
        if len(shown.lines()) > before:
            spoken.append(second)
    assert spoken[:3] == [60, 90, 120]
    assert 60 < len(spoken) < 100  # of six hours
    assert spoken[-1] - spoken[-2] > 900


def test_what_went_before_and_what_comes_later_is_part_of_the_whole():
    shown = Shown(terminal=False, before=4000, later=2000)
    shown.display.start("one")
    shown.display.steps("one", 0)
    shown.now = 30.0
    shown.display.steps("one", 600)
    shown.display.tick()
    # 5,400 steps are left, 2,000 of them of jobs that nobody has named yet, at 20 steps/s.
    assert shown.lines()[1] == "Training: 46 %, 4,600/10,000 steps, 20 steps/s, 0:04:30 left"


def test_the_whole_is_not_done_before_its_slowest_run():
    shown = Shown(terminal=False, totals={"fast": 1000, "slow": 1000})
    for name in ("fast", "slow"):
        shown.display.start(name)
        shown.display.steps(name, 0)
    shown.now = 30.0
    shown.display.steps("fast", 800)
    shown.display.steps("slow", 200)
    shown.display.tick()
    assert shown.lines()[2].endswith(
        ", 0:02:00 left"
    )  # not 0:00:30, all that is left at both speeds together
    assert shown.lines()[4].endswith(", 0:02:00 left")


def test_random_actions_before_learning_are_soon_forgotten():
    shown = Shown(terminal=False, totals={"one": 10_000})
    shown.display.start("one")
    for second, done in ((0.0, 0), (1.0, 2000)):  # without updates
        shown.now = second
        shown.display.steps("one", done)
    for second in range(2, 31):
        shown.now = float(second)
        shown.display.steps("one", 2000 + 100 * (second - 1))
    shown.display.tick()
    assert shown.lines()[1].endswith(", 0:00:51 left")  # 5,100 steps at 100 steps/s


@pytest.mark.parametrize(
    ("speed", "text"),
    [(0.0, ""), (0.4, "2.5 s/episode"), (1.0, "1 episodes/s"), (1234.4, "1,234 episodes/s")],
)
def test_what_is_slow_is_told_in_seconds(speed, text):
    assert speed_text(speed, "episodes") == text


def test_a_pace_is_of_the_last_seconds_and_over_all():
    pace = Pace()
    assert (pace.lately, pace.overall, left_text(math.inf)) == (0.0, 0.0, "")
    pace.report(0.0, 500)
    assert (pace.lately, pace.overall) == (0.0, 0.0)
    for second in range(1, 101):
        pace.report(float(second), 500 + 100 * second)
    for second in range(101, 201):
        pace.report(float(second), 10_500 + 10 * (second - 100))
    assert pace.lately == pytest.approx(10.0)
    assert pace.overall == pytest.approx(55.0)
    pace.report(300.0, 11_501)  # one report in a hundred seconds is still a pace
    assert pace.lately == pytest.approx(0.01)
