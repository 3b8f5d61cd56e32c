"""The fault matrix: it has every export, its table is that of the code, and it sees what is silent."""

import csv
import inspect

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from benchmarks import fault_matrix
from benchmarks.faults.constraint_examples import EXAMPLES, NO_CONSTRAINT
from benchmarks.faults.lifecycle import lifecycle
from benchmarks.faults.outcomes import DEFECTS, Outcome
from benchmarks.faults.stacks import Row, rows
from safe_wrappers.wrappers.faults import FAULTS

pytestmark = pytest.mark.filterwarnings("ignore")

WRAPPERS = {
    name
    for name in sw.__all__
    if inspect.isclass(getattr(sw, name))
    and issubclass(getattr(sw, name), gym.Wrapper | gym.vector.VectorWrapper)
}
QUICK = {
    ("NaN", "all"), ("huge", "1e30"), ("wrong dtype", "text"), ("wrong dtype", "complex"), ("wrong shape", "longer"),
    ("list", ""), ("NaN in the state", "NaN"), ("env raises", "in step"), ("two threads", "step"),
    ("deep-copied in the middle", ""),
}  # fmt: skip


def test_every_export_has_a_row_and_nothing_else_has():
    assert {row.name for row in rows() if row.kind == "wrapper"} == WRAPPERS | set(FAULTS)
    constraints = {row.name for row in rows() if row.kind == "constraint"}
    assert constraints | set(NO_CONSTRAINT) == set(sw.constraints.__all__)
    assert constraints == set(EXAMPLES) and not constraints & set(NO_CONSTRAINT)


def test_the_stored_matrix_is_whole_and_has_no_defect():
    with fault_matrix.RESULTS.open(newline="") as file:
        stored = list(csv.DictReader(file))
    first = next(rows())
    cells = set(fault_matrix.cells(first))
    assert {(c["row"], c["example"]) for c in stored} == {(row.name, row.case) for row in rows()}
    for row in rows():
        mine = [c for c in stored if (c["row"], c["example"]) == (row.name, row.case)]
        assert {(c["fault"], c["variant"]) for c in mine} == cells and len(mine) == len(cells), row
    assert not [c for c in stored if c["outcome"] in DEFECTS]
    assert {c["outcome"] for c in stored} <= set(Outcome)


FIRST = {row.name: row for row in reversed(list(rows())) if row.kind == "wrapper"}


@pytest.mark.parametrize("name", sorted(FIRST))
def test_every_wrapper_under_the_quick_faults(name):
    found = fault_matrix.judge(FIRST[name], only=QUICK)
    assert len(found) == len(QUICK)
    assert not [cell for cell in found if cell["outcome"] in DEFECTS]


@pytest.mark.slow
@pytest.mark.parametrize("row", list(rows()), ids=lambda row: f"{row.name} {row.case}")
def test_the_whole_matrix(row):
    assert not [cell for cell in fault_matrix.judge(row) if cell["outcome"] in DEFECTS]


# It sees what a bad wrapper does ------------------------------------------------------------------------------


class Bad(gym.Wrapper):
    """Passes everything on; what a subclass does is wrong."""

    def step(self, action):
        return self.env.step(action)


class HidesNaN(Bad):
    def step(self, action):
        return self.env.step(np.nan_to_num(action))


class Clips(Bad):
    def step(self, action):
        return self.env.step(np.clip(action, -1.0, 1.0))


class Remembers(Bad):
    worse = 1.0

    def step(self, action):
        if not np.isfinite(action).all():
            self.worse = 0.5
            raise sw.SafeWrappersError("expected finite numbers")
        return self.env.step(action * self.worse)


class Mumbles(Bad):
    def step(self, action):
        return self.env.step({}[0] if not np.isfinite(action).all() else action)


@pytest.mark.parametrize(
    ("wrapper", "fault", "outcome"),
    [
        (Bad, ("NaN", "all"), Outcome.NON_FINITE),
        (Bad, ("huge", "1e30"), Outcome.OUTSIDE),
        (Bad, ("two threads", "step"), Outcome.SILENT),
        (Bad, ("two threads", "reset"), Outcome.SILENT),
        (Bad, ("deep-copied in the middle", ""), Outcome.DIVERGED),
        (Bad, ("pickled in the middle", ""), Outcome.DIVERGED),
        (HidesNaN, ("NaN", "all"), Outcome.SILENT),
        (Clips, ("huge", "1e300"), Outcome.SILENT),
        (Remembers, ("NaN", "all"), Outcome.DIVERGED),
        (Mumbles, ("NaN", "all"), Outcome.CRASHED),
    ],
)
def test_a_wrapper_that_is_wrong_is_seen(wrapper, fault, outcome):
    row = Row("Bad", "", lambda around, **more: wrapper(around(gym.make("Reacher-v5"))))
    (found,) = fault_matrix.judge(row, only={fault})
    assert found["outcome"] == outcome, found


def test_a_guard_that_is_gone_is_seen(monkeypatch):
    from safe_wrappers.wrappers.layer import LayerWrapper

    monkeypatch.setattr(LayerWrapper, "_pass_on", lambda self, action: self.env.step(action))
    (found,) = fault_matrix.judge(FIRST["CostFunction"], only={("NaN", "all")})
    assert found["outcome"] == Outcome.NON_FINITE
    assert lifecycle(FIRST["CostFunction"])


# What the matrix found, and how it says it ---------------------------------------------------------------------


def test_a_second_thread_is_told_what_to_do_and_the_first_goes_on():
    row = FIRST["RecordInterventions"]
    (found,) = fault_matrix.judge(row, only={("two threads", "step")})
    assert found["outcome"] == Outcome.REFUSED and "give every thread an env of its own" in found["note"]


def test_a_copy_that_has_lost_its_state_asks_for_a_reset_and_one_that_has_not_goes_on():
    (lost,) = fault_matrix.judge(FIRST["CBFActionFilter"], only={("deep-copied in the middle", "")})
    assert lost["outcome"] == Outcome.REFUSED and "call reset before step" in lost["note"]
    barrier = next(row for row in rows("Barrier"))  # Pendulum is copied with its state
    (kept,) = fault_matrix.judge(barrier, only={("deep-copied in the middle", "")})
    assert kept["outcome"] == Outcome.HARMLESS


def test_a_recorder_over_a_filter_leaves_what_is_not_finite_to_the_filter():
    env = sw.RecordInterventions(
        sw.CBFActionFilter(gym.make("Reacher-v5"), [sw.constraints.JointSpeedLimit(4.0)])
    )
    env.reset(seed=0)
    assert env.step(np.full(2, np.nan))[4]["cbf/nonfinite"]
    alone = sw.RecordInterventions(gym.make("Reacher-v5"))
    alone.reset(seed=0)
    for bad in (np.full(2, np.nan), ["0.1", "0.1"], [[0.1], [0.1, 0.2]], np.array([0.1j, 0.1])):
        with pytest.raises(sw.SafeWrappersError, match="finite numbers"):
            alone.step(bad)


def test_commands_from_the_future_are_counted_as_lost():
    env = sw.TeleopChannel(gym.make("Reacher-v5"), 0.0, 0.0)
    env.reset(seed=0)
    assert env.step(np.zeros(2, np.float32))[4]["teleop/lost"] == 0
    env.set_observation_time(env.now_s + 1.0)
    assert env.step(np.zeros(2, np.float32))[4]["teleop/lost"] == 1


def test_a_budget_reads_nothing_of_a_state_that_is_broken_elsewhere():
    budget = sw.StoppingBudget(sw.constraints.JointPositionLimit(-2.0, 2.0, ["joint1"]), closing_speed=1.0)
    env = sw.LeaseExpiry(gym.make("Reacher-v5"), budget, fallback="zero")
    env.reset(seed=0)
    assert not env.step(np.zeros(2, np.float32))[4]["lease/refused"]
    env.unwrapped.data.qpos[0] = np.nan  # of joint0
    assert env.step(np.zeros(2, np.float32))[4]["lease/refused"]


def leased(env):
    limit = sw.constraints.JointPositionLimit(-2.0, 2.0, ["joint1"])
    return sw.LeaseExpiry(env, sw.StoppingBudget(limit, closing_speed=1.0))


DECIDE_NOTHING = {
    "handover/clipped": lambda env: sw.ChunkHandover(env, 1, 1, blend="replace", fallback="zero"),
    "lease/clipped": leased,
    "teleop/clipped": lambda env: sw.TeleopChannel(env, 0.0, 0.0),
}


@pytest.mark.parametrize(("key", "make"), DECIDE_NOTHING.items())
def test_who_decides_nothing_counts_actions_outside_the_space_and_warns_once(key, make, recwarn):
    env = make(gym.make("Reacher-v5"))
    assert env.reset(seed=0)[1][key] == 0.0
    told = {}
    odd = (np.nan, 1.25), (np.nan, -np.inf), (-1.0, 1.0), (3e300, -4e300)
    for action in ((0.5, 1.0), (0.5, 1.5), (-2.0, 3.0), *odd):
        told[action] = env.step(np.array(action))[4][key]
        warned = [w for w in recwarn if "left the action space by 0.5" in str(w.message)]
        assert len(warned) == (len(told) > 1)
    assert list(told.values()) == pytest.approx([0.0, 0.5, 5.0**0.5, 0.25, 0.0, 0.0, 5e300], abs=0)
    assert not [w for w in recwarn if w.category is RuntimeWarning and "/safe_wrappers/" in w.filename]
    assert warned[0].filename == __file__


def test_of_a_chunk_the_worst_entry_counts_and_a_filter_inside_counts_itself():
    env = sw.ChunkHandover(gym.make("Reacher-v5"), 3, 2, rate_limit=1e3, fallback="zero")
    env.reset(seed=0)
    for last, expected in ((4.0, 3.0), (-1.0, 1.0)):
        found = env.step(np.array([[0.0, 0.0], [0.0, -2.0], [last, 0.5]]))[4]
        assert found["handover/clipped"] == expected
    filtered = sw.CBFActionFilter(gym.make("Reacher-v5"), [sw.constraints.JointSpeedLimit(4.0)])
    for env in (leased(filtered), sw.TeleopChannel(filtered, 0.0, 0.0)):
        env.reset(seed=0)
        info = env.step(np.array([0.0, 3.0]))[4]
        assert info["cbf/clipped"] == 2.0 and not {"lease/clipped", "teleop/clipped"} & info.keys()
