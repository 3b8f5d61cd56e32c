"""ray_efficiency: its arithmetic, and that every way has the same runs, in folders of their own."""

from types import SimpleNamespace

import pytest

pytest.importorskip("stable_baselines3")

from benchmarks import ray_efficiency as measured


def test_efficiency_is_the_time_of_one_cpu_over_that_of_all():
    found = {measured.ALONE: (1, 100.0, 0.0), measured.LOCAL: (2, 50.0, 0.0), measured.RAY: (2, 62.5, 7.0)}
    rows = measured.rows_of(found)
    assert [row.efficiency for row in rows] == pytest.approx([1.0, 1.0, 0.8])
    assert measured.table(rows).splitlines()[2:] == [
        "| one after another | 1 | 100 s | 100% | - |",
        "| two processes | 2 | 50 s | 100% | - |",
        "| two Ray nodes | 2 | 62 s | 80% | 7 s |",
    ]


def test_every_way_has_the_same_four_runs(monkeypatch, tmp_path):
    ran = {}
    clock = iter([0.0, 40.0, 40.0, 65.0, 65.0, 70.0, 70.0, 100.0])

    def run(work, workers, console, way, on=None):
        assert workers == 2 and (on == "ray") == (way == measured.RAY)
        ran[way] = work

    def alone(work):
        ran[measured.ALONE] = work

    class Nodes:
        def __enter__(self):
            ran["cluster"] = []

        def __exit__(self, *_):
            pass

    monkeypatch.setattr(measured, "run_jobs", run)
    monkeypatch.setattr(measured, "one_after_another", alone)
    monkeypatch.setattr(measured, "nodes", Nodes)
    monkeypatch.setattr(measured, "time", SimpleNamespace(perf_counter=lambda: next(clock)))
    rows = measured.measure(1024)
    assert list(ran) == [measured.ALONE, measured.LOCAL, "cluster", measured.RAY]
    assert [(row.cpus, row.seconds, row.start_s) for row in rows] == [(1, 40, 0), (2, 25, 0), (2, 30, 5)]
    work = [ran[way] for way in (measured.ALONE, measured.LOCAL, measured.RAY)]
    assert [[(job.name, job.total) for job in each] for each in work] == 3 * [
        [(f"training filtered seed {seed}", 1024) for seed in range(4)]
    ]
    assert len({job.arguments[2] for each in work for job in each}) == 12


def test_one_after_another_calls_each_with_its_arguments_and_somewhere_to_report():
    told = []
    job = SimpleNamespace(arguments=(1, 2), call=lambda *given: told.append(given[:2]) or given[2].say("x"))
    measured.one_after_another([job, job])
    assert told == [(1, 2), (1, 2)]
