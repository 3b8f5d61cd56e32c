"""What two CPUs make of four short trainings: one after another, in two processes, and on two Ray nodes.

    python -m benchmarks.ray_efficiency      # minutes, on a machine with two idle cores; needs the extra `ray`

Four seeds of one arm of one config, without evaluation. One after another they train in this process, which has
loaded everything. Two processes, and a head with two nodes of one CPU each on this machine, begin each run in a fresh
process, as `safe-wrappers train` does: that is part of their time; the start of the cluster is told beside it.
Efficiency is the first time over the CPUs times the other.
"""

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.console import Console

from benchmarks.tables import RESULTS, keep, markdown
from safe_wrappers.train.config import parse_experiment, read_config
from safe_wrappers.train.experiment import training_jobs
from safe_wrappers.train.processes.job import Job, Progress
from safe_wrappers.train.processes.parallel import run_jobs

ROOT = Path(__file__).parents[1]
CPUS, RUNS = 2, 4
ALONE, LOCAL, RAY = "one after another", "two processes", "two Ray nodes"


@dataclass(frozen=True)
class Row:
    """One way of running them.

    Attributes:
        way: Which.
        cpus: How many it may use.
        seconds: Wall time of all runs.
        start_s: Wall time before them, of a cluster that begins.
        efficiency: Of its CPUs, against one after another.
    """

    way: str
    cpus: int
    seconds: float
    start_s: float
    efficiency: float


def rows_of(seconds: dict[str, tuple[int, float, float]]) -> list[Row]:
    """Rows of (CPUs, seconds, seconds of the start) by way; `ALONE` is what the others are held against."""
    alone = seconds[ALONE][1]
    return [Row(way, cpus, s, start, alone / (cpus * s)) for way, (cpus, s, start) in seconds.items()]


def table(rows: list[Row]) -> str:
    """Markdown: one line per way."""
    lines = []
    for row in rows:
        start = f"{row.start_s:.0f} s" if row.start_s else "-"
        lines.append((row.way, row.cpus, f"{row.seconds:.0f} s", f"{row.efficiency:.0%}", start))
    return markdown(f"{RUNS} runs | CPUs | wall time | efficiency | start of the cluster", lines)


def jobs(steps: int, folder: Path) -> list[Job]:
    """The same runs, into a folder of their own."""
    seeds = list(range(RUNS))
    overrides = [f"output={folder}", f"total_steps={steps}", f"seeds={seeds}"]
    experiment = parse_experiment(read_config(ROOT / "configs" / "pointgoal1_300k.yaml", overrides))
    return training_jobs(experiment, [arm for arm in experiment.arms if arm.name == "filtered"])


def one_after_another(work: list[Job]) -> None:
    """All of them in this process."""
    for job in work:
        job.call(*job.arguments, Progress(lambda _: None, lambda _: None))


@contextmanager
def nodes() -> Iterator[None]:
    """A head that runs nothing, and nodes of one CPU, to which `--on ray` then goes."""
    import ray
    from ray.cluster_utils import Cluster

    memory = 100 * 1024**2  # no run puts anything into the store
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "object_store_memory": memory})
    try:
        for _ in range(CPUS):
            cluster.add_node(num_cpus=1, object_store_memory=memory)
        ray.init(address=cluster.address, log_to_driver=False, logging_level="ERROR")
        cluster.wait_for_nodes()
        yield
    finally:
        ray.shutdown()
        cluster.shutdown()


def seconds_of(call: Callable[[], None]) -> float:
    """Wall time of a call."""
    begin = time.perf_counter()
    call()
    return time.perf_counter() - begin


def measure(steps: int) -> list[Row]:
    """Run them in all three ways."""
    import torch

    torch.set_num_threads(1)  # as every run elsewhere has
    console, found = Console(stderr=True), dict[str, tuple[int, float, float]]()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        one_after_another(jobs(1, folder / "warm")[:1])  # compiles what is cached from then on
        found[ALONE] = 1, seconds_of(lambda: one_after_another(jobs(steps, folder / "alone"))), 0.0
        local = jobs(steps, folder / "local")
        found[LOCAL] = CPUS, seconds_of(lambda: run_jobs(local, CPUS, console, LOCAL)), 0.0
        far, begin = jobs(steps, folder / "ray"), time.perf_counter()
        with nodes():
            start = time.perf_counter() - begin
            found[RAY] = CPUS, seconds_of(lambda: run_jobs(far, CPUS, console, RAY, on="ray")), start
    return rows_of(found)


def main() -> None:
    """Measure, print the table, keep the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--steps", type=int, default=60_000, help="of each run")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder for the rows and the table")
    arguments = parser.parse_args()
    rows = measure(arguments.steps)
    found = {"steps": arguments.steps, "rows": [asdict(row) for row in rows]}
    keep(arguments.results, "ray_efficiency", found, table(rows))


if __name__ == "__main__":
    main()
