"""`compare` is killed at random moments until it has come to its end; is what is there then what should be there?

    python -m benchmarks kills                          # 20 kills, some minutes of one core
    python -m benchmarks kills --seeds 2 --workers 2    # runs side by side

The command of `benchmarks/kills.yaml` runs as at a terminal: PPO without a filter and SAC through one, checkpoints,
evaluation, report. SIGKILL goes to its whole process group at a random moment, and the same command is given again,
up to six times, then once more to its end. What was finished before a kill must be there after it, unchanged. What
the last kill left is copied, and goes on twice: both must come to the same, bit for bit but for what a wall clock
says. No temporary file may be left.
"""

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.tables import keep, markdown, options

CONFIG = Path(__file__).with_suffix(".yaml")
KILLS_A_ROUND = 6
WALL_CLOCK = ("filter_time_us", "elapsed_s", "steps_per_s")
"""No two runs have the same ones."""
PHASES = ("start", "training", "evaluation", "report")
DONE = ("finished.json", "evaluation/evaluation.json")
"""Of a run: what says that its training, its evaluation is finished."""


def command(folder: Path, settings: list[str], seconds: float | None = None) -> int | None:
    """Gives the command; its exit status, None if it was killed after so many seconds.

    Raises:
        RuntimeError: It ended by itself with an error.
    """
    line = [sys.executable, "-c", "import sys; from safe_wrappers.train.cli import main; sys.exit(main())"]
    line += ["compare", str(CONFIG), f"output={folder}", *settings, "--report"]
    log = folder.with_suffix(".log")
    with log.open("ab") as out:
        process = subprocess.Popen(line, stdout=out, stderr=out, start_new_session=True)
        try:
            status = process.wait(seconds)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            return None
    if status:
        raise RuntimeError(f"the command ended with {status}, see {log}")
    return status


def runs(folder: Path) -> list[Path]:
    """The folders of runs that have begun."""
    return sorted(path.parent for path in folder.rglob("run.json"))


def phase(folder: Path, expected: int) -> str:
    """In which phase the files say that a comparison of so many runs is."""
    found = runs(folder)
    done = [sum((run / name).exists() for run in found) for name in DONE]
    if not found:
        return "start"
    return "training" if done[0] < expected else "evaluation" if done[1] < expected else "report"


def content(path: Path) -> bytes:
    """What a file says but for the wall clock (SB3's `data` has the start's) and for checksums of other files."""
    if path.suffix == ".json":
        return json.dumps(_timeless(json.loads(path.read_text())), sort_keys=True).encode()
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as file:
            members = [
                name for name in sorted(file.namelist()) if Path(name).stem not in (*WALL_CLOCK, "data")
            ]
            return b"".join(name.encode() + file.read(name) for name in members)
    return path.read_bytes()


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _timeless(one) for key, one in value.items() if key not in WALL_CLOCK and "." not in key}
    return [_timeless(one) for one in value] if isinstance(value, list) else value


def left_by(folder: Path, finished: bool = False) -> dict[str, str]:
    """What runs leave but for their checkpoints, by file, as checksums; with `finished` only what will not change."""
    found: dict[str, str] = {}
    for run in runs(folder):
        trained, evaluated = ((run / name).exists() for name in DONE)
        for path in sorted(path for path in run.rglob("*") if path.is_file()):
            part = path.relative_to(run).parts[0]
            over = evaluated if part == "evaluation" else trained
            if (
                part != "checkpoints"
                and path.suffix in (".csv", ".json", ".npz", ".zip", ".pkl")
                and (over or not finished)
            ):
                found[str(path.relative_to(folder))] = hashlib.sha256(content(path)).hexdigest()
    return found


def round_of_kills(
    number: int, folder: Path, typical_s: float, expected: int, settings: list[str]
) -> dict[str, Any]:
    """One comparison: some kills, then its end, twice; and what is wrong with it then."""
    rng = np.random.default_rng([20261123, number])
    twin = folder.with_name(f"{folder.name}_again")
    for old in (folder, twin):
        shutil.rmtree(old, ignore_errors=True)
    folder.mkdir(parents=True)
    kills, wrong = [], []
    for _ in range(KILLS_A_ROUND):
        before = left_by(folder, finished=True)
        if command(folder, settings, float(rng.uniform(0.2, 1.0)) * typical_s) is not None:
            break
        after = left_by(folder, finished=True)
        lost = [name for name, checksum in before.items() if after.get(name) != checksum]
        kills.append({"phase": phase(folder, expected), "lost": len(lost)})
        wrong += [f"{name} is gone or changed after a kill" for name in lost]
    shutil.copytree(folder, twin)
    before = left_by(folder, finished=True)
    for one in (folder, twin):
        command(one, settings)
    first, second = left_by(folder), left_by(twin)
    wrong += [f"{name} was made again" for name, checksum in before.items() if first.get(name) != checksum]
    differ = sorted(name for name in first.keys() | second.keys() if first.get(name) != second.get(name))
    wrong += [f"{name} is another one when it goes on twice" for name in differ]
    if phase(folder, expected) != "report" or len(runs(folder)) != expected:
        wrong.append("not all runs are finished")
    wrong += [f"left behind: {path}" for path in folder.rglob(".*") if path.name != ".lock"]
    if not wrong:
        shutil.rmtree(folder)
        shutil.rmtree(twin)
    return {"kills": kills, "wrong": wrong}


def table(rounds: list[dict[str, Any]]) -> str:
    """Markdown: kills and results lost by phase, and what was wrong."""
    kills = [kill for one in rounds for kill in one["kills"]]
    counts, lost = Counter(kill["phase"] for kill in kills), Counter[str]()
    for kill in kills:
        lost[kill["phase"]] += kill["lost"]
    lines = [[name, counts[name], lost[name]] for name in PHASES] + [["all", counts.total(), lost.total()]]
    same = sum(not one["wrong"] for one in rounds)
    said = f"{same} of {len(rounds)} comparisons came to an end with nothing lost, made again or different."
    wrong = "".join(f"\n* {line}" for one in rounds for line in one["wrong"])
    return f"{markdown('killed in | kills | results lost', lines)}\n\n{said}{wrong}"


def main() -> None:
    """Kill until there are enough kills."""
    given = options(__doc__, kills=20, seeds=1, workers=1, name="kills")
    folder = (Path("runs") / given.name).resolve()
    settings = [f"seeds={list(range(given.seeds))}", f"workers={given.workers}"]
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "undisturbed").mkdir(parents=True)
    began = time.monotonic()
    command(folder / "undisturbed", settings)
    typical_s, expected = time.monotonic() - began, len(runs(folder / "undisturbed"))
    rounds: list[dict[str, Any]] = []
    while sum(len(one["kills"]) for one in rounds) < given.kills:
        number = len(rounds)
        rounds.append(round_of_kills(number, folder / f"round_{number}", typical_s, expected, settings))
        print(rounds[-1], flush=True)
    keep(given.name, table(rounds))
