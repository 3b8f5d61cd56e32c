"""`compare` is killed at random moments until it has come to its end; is what is there then what should be there?

    python -m benchmarks.kills                                            # 120 kills, some minutes
    python -m benchmarks.kills --seeds 2 --workers 2 --kills 12 --name kills_together    # runs side by side

The command of `benchmarks/kills.yaml` runs in a process group of its own: PPO without a filter and SAC through one,
checkpoints, evaluation, report. SIGKILL goes to the whole group, at a random moment of a phase that is drawn, and the
same command is given again; after some kills it is left alone to its end. Whatever takes long to import is imported
once, and commands and runs are forked from there instead of started (`multiprocessing`'s fork for its spawn): nothing
else is other than at a terminal. Films are left out (no display is needed then). It goes on where it was stopped.

What should be there. A run that goes on from a checkpoint makes new episodes, so a run that was killed is not the one
that was not. But it must be the run that was cut off cleanly right after the checkpoints from which it went on: such
runs are made too, in this order, and all that a run leaves is compared with theirs bit for bit: rows of training and
evaluation, every step of the evaluation, weights, scaling. A run that lost no step must be the undisturbed one. Steps
that are made again must be those since the last checkpoint, and what was finished before a kill must still be there
after it, as it was.
"""

import argparse
import ctypes
import hashlib
import io
import json
import mmap
import multiprocessing
import os
import pickle
import select
import shutil
import signal
import struct
import time
import traceback
import zipfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch

from benchmarks.tables import RESULTS
from safe_wrappers.train import cli, experiment
from safe_wrappers.train.config import ArmConfig, ExperimentConfig, parse_experiment, read_config
from safe_wrappers.train.evaluation.evaluate import evaluate_run
from safe_wrappers.train.processes import Progress
from safe_wrappers.train.run import training
from safe_wrappers.train.run.callbacks import EpisodeRows
from safe_wrappers.train.run.checkpoint import latest_checkpoint
from safe_wrappers.train.run.data_pickles import read_pickle
from safe_wrappers.train.run.training import train_run
from safe_wrappers.train.videos import record

CONFIG = Path(__file__).with_suffix(".yaml")
PHASES = ("start", "training", "checkpoint", "policy", "evaluation", "report")
"""A checkpoint's is that of its writing; the policy's from the last checkpoint to the note that a run is finished."""
KILLS_A_ROUND = 6
LONGEST_S = 300.0
WALL_CLOCK = ("filter_time_us", "elapsed_s", "steps_per_s")
"""No two runs have the same ones."""
QUIET = Progress(lambda _: None, lambda _: None)
_SUBREAPER = 36


@dataclass
class Attempt:
    """One command: how it ended, in which phase (of runs side by side: the last that began), and their steps."""

    status: int | None
    """None: it was killed."""
    phase: str
    run: str
    steps: dict[str, tuple[int, int]]
    """By run: those that it has made, and of these those that were in a checkpoint."""
    seconds: dict[tuple[str, str], list[float]] = field(default_factory=dict)
    """How long its phases took, by phase and run, in their order."""


class Stage:
    """What forked processes say of themselves: their phases through a pipe, their steps in shared memory."""

    def __init__(self, runs: Sequence[str]) -> None:
        self.told, self._tell = os.pipe()
        self._places = {run: 16 * place for place, run in enumerate(runs)}
        self._steps = mmap.mmap(-1, 16 * len(runs))
        self.run = ""  # of this process

    def say(self, phase: str, run: str = "") -> None:
        os.write(self._tell, f"{phase} {run}\n".encode())

    def note(self, steps: int, saved: bool = False) -> None:
        struct.pack_into("q", self._steps, self._places[self.run] + 8 * saved, steps)

    def noted(self) -> dict[str, tuple[int, int]]:
        return {run: struct.unpack_from("qq", self._steps, place) for run, place in self._places.items()}


def staged(stage: Stage) -> list[Any]:
    """Patches that tell where the command is."""
    train, save = training.train_run, training.save_checkpoint
    evaluate, summarize, step = experiment.evaluate_run, experiment.summarize_experiment, EpisodeRows._on_step
    fork = multiprocessing.get_context("fork")

    def trained(arm: ArmConfig, seed: int, *given: Any, **named: Any) -> None:
        stage.run = _name(arm, seed)
        stage.say("training", stage.run)
        train(arm, seed, *given, **named)
        stage.say("start")

    def saved(root: Path, model: Any, *given: Any, final: bool = False, **named: Any) -> Path:
        stage.say("checkpoint", stage.run)
        folder: Path = save(root, model, *given, final=final, **named)
        stage.note(model.num_timesteps, saved=True)
        stage.say("policy" if final else "training", stage.run)
        return folder

    def stepped(self: EpisodeRows) -> bool:
        stage.note(self.num_timesteps)
        return step(self)

    def evaluated(arm: ArmConfig, seed: int, *given: Any) -> None:
        stage.say("evaluation", _name(arm, seed))
        evaluate(arm, seed, *given)
        stage.say("start")

    def summarized(*given: Any) -> Any:
        stage.say("report")
        return summarize(*given)

    return [
        mock.patch.object(multiprocessing, "get_context", lambda _: fork),
        mock.patch.object(record, "_render_modes", lambda _: ()),
        mock.patch.object(experiment, "train_run", trained),
        mock.patch.object(training, "save_checkpoint", saved),
        mock.patch.object(EpisodeRows, "_on_step", stepped),
        mock.patch.object(experiment, "evaluate_run", evaluated),
        mock.patch.object(experiment, "summarize_experiment", summarized),
    ]


def in_a_fork(work: Callable[[], int], log: Path) -> int:
    """Does work in a forked process, a group of its own; returns its id."""
    child = os.fork()
    if child:
        os.setpgid(child, child)  # here too: whichever of the two comes first
        return child
    os.setpgid(0, 0)
    out = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(out, 1)
    os.dup2(out, 2)
    try:
        os._exit(work())
    except BaseException:
        os.write(2, traceback.format_exc().encode())
        os._exit(70)


def ended(group: int) -> int:
    """Waits for all processes of a group; returns the first one's status."""
    status = 0
    while True:
        try:
            child, how = os.waitpid(-group, 0)
        except ChildProcessError:
            return status
        if child == group:
            status = os.waitstatus_to_exitcode(how)


def attempt(
    folder: Path,
    settings: Sequence[str] = (),
    target: tuple[str, str] | None = None,
    skip: int = 0,
    delay_s: float = 0.0,
) -> Attempt:
    """Gives the command; kills it so long after the phase begins that comes after `skip` such ones."""
    stage = Stage(list(runs_of(read_experiment(folder, settings))))

    def command() -> int:
        for patch in staged(stage):
            patch.start()
        stage.say("start")
        return cli.main(["compare", str(CONFIG), f"output={folder}", *settings, "--report"])

    group = in_a_fork(command, folder.with_suffix(".log"))
    os.close(stage._tell)
    now, since, left = ("start", ""), time.monotonic(), skip
    seconds: dict[tuple[str, str], list[float]] = {}
    kill_at: float | None = None
    killed, text = False, b""
    give_up = since + LONGEST_S
    while True:
        wait_s = max(0.0, (give_up if kill_at is None else kill_at) - time.monotonic())
        if not select.select([stage.told], [], [], wait_s)[0]:
            os.killpg(group, signal.SIGKILL)
            killed = True
            if kill_at is None:
                raise TimeoutError(f"{folder}: more than {LONGEST_S:.0f} s in phase {now}")
            break
        got = os.read(stage.told, 4096)
        if not got:
            seconds.setdefault(now, []).append(time.monotonic() - since)
            break
        *lines, text = (text + got).split(b"\n")
        for line in lines:
            seconds.setdefault(now, []).append(time.monotonic() - since)
            now = _place(line)
            since = time.monotonic()
            if now == target and kill_at is None:
                kill_at, left = (since + delay_s, left) if left == 0 else (None, left - 1)
    status = ended(group)
    # What it had still said before it was gone.
    while killed and (got := os.read(stage.told, 4096)):
        *lines, text = (text + got).split(b"\n")
        if lines:
            now = _place(lines[-1])
    os.close(stage.told)
    return Attempt(None if killed else status, *now, stage.noted(), seconds)


def _place(line: bytes) -> tuple[str, str]:
    phase, _, run = line.decode().partition(" ")
    return phase, run


def read_experiment(folder: Path, settings: Sequence[str] = ()) -> ExperimentConfig:
    return parse_experiment(read_config(CONFIG, [f"output={folder}", *settings]))


def _name(arm: ArmConfig, seed: int) -> str:
    return f"{arm.name}_{seed}"


def runs_of(told: ExperimentConfig) -> dict[str, tuple[ArmConfig, int]]:
    """By name."""
    return {_name(arm, seed): (arm, seed) for seed in told.seeds for arm in told.arms}


def cut_off(folder: Path, arm: ArmConfig, seed: int, cuts: tuple[int, ...]) -> Path:
    """A run that is cut off cleanly after each of these checkpoints, then trained to its end and evaluated."""
    told = read_experiment(folder)
    run = told.run_folder(arm, seed)
    save = training.save_checkpoint

    def part(cut: int | None) -> int:
        def saved(root: Path, model: Any, *given: Any, **named: Any) -> Path:
            made = save(root, model, *given, **named)
            if model.num_timesteps == cut:
                os._exit(0)
            return made

        with mock.patch.object(training, "save_checkpoint", saved):
            train_run(arm, seed, run, QUIET)
            evaluate_run(arm, seed, run, told.evaluation, told.evaluation_filter, QUIET)
        return 0

    folder.mkdir(parents=True, exist_ok=True)
    for cut in (*cuts, None):
        if ended(in_a_fork(lambda cut=cut: part(cut), folder.with_suffix(".log"))):  # type: ignore[misc]
            raise RuntimeError(f"see {folder.with_suffix('.log')}")
    return run


def left_by(run: Path) -> dict[str, str]:
    """What a run leaves, by file and array, as checksums; not what a wall clock says."""
    found: dict[str, Any] = {name: (run / name).read_bytes() for name in ("run.json", "episodes.csv")}
    facts = json.loads((run / "finished.json").read_text())
    found["finished.json"] = json.dumps(
        {key: value is None if key in WALL_CLOCK else value for key, value in facts.items()}
    ).encode()
    for path in sorted((*run.glob("evaluation/*.csv"), *run.glob("policy/*.json"))):
        found[str(path.relative_to(run))] = path.read_bytes()
    with zipfile.ZipFile(run / "policy" / "model.zip") as model:
        weights = torch.load(io.BytesIO(model.read("policy.pth")), weights_only=True)
    found |= {f"policy:{name}": tensor.numpy().tobytes() for name, tensor in weights.items()}
    scaling = run / "policy" / "vecnormalize.pkl"
    if scaling.exists():
        found["scaling"] = pickle.dumps(read_pickle(scaling).obs_rms)
    for path in sorted(run.glob("*/*.npz")):
        with np.load(path, allow_pickle=False) as arrays:
            for name in arrays.files:
                if name not in WALL_CLOCK:
                    found[f"{path.relative_to(run)}:{name}"] = (
                        str(arrays[name].dtype).encode() + arrays[name].tobytes()
                    )
    return {name: hashlib.sha256(data).hexdigest() for name, data in found.items()}


def done(told: ExperimentConfig) -> dict[str, str]:
    """What is finished by now, as checksums: nothing of it may go or change."""
    found = {}
    for name, (arm, seed) in runs_of(told).items():
        run = told.run_folder(arm, seed)
        of_training = ("finished.json", "episodes.csv", "policy/config.json", "policy/model.zip")
        names = of_training if (run / "finished.json").exists() else ()
        if (run / "evaluation" / "evaluation.json").exists():
            names = (*names, *(f"evaluation/{path.name}" for path in (run / "evaluation").iterdir()))
        for file in names:
            found[f"{name}/{file}"] = hashlib.sha256((run / file).read_bytes()).hexdigest()
    return found


def resumes_at(run: Path) -> int:
    """The step from which a run will go on."""
    checkpoint = latest_checkpoint(run / "checkpoints")
    return 0 if checkpoint is None else checkpoint.timesteps


def round_of_kills(
    number: int, folder: Path, typical: dict[tuple[str, str], float], settings: Sequence[str] = ()
) -> dict[str, Any]:
    """One comparison: some kills, then its end; and what is wrong with it then."""
    rng = np.random.default_rng([20261123, number])
    told = read_experiment(folder, settings)
    runs = runs_of(told)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    cuts: dict[str, list[int]] = {run: [] for run in runs}
    kills, wrong = [], []
    # In the order in which they come, so that none is behind the end of the one before.
    places = list(typical)
    for at in sorted(rng.integers(0, len(places), KILLS_A_ROUND)):
        skip = int(rng.integers(0, 2)) if places[at][0] in ("training", "checkpoint") else 0
        before = done(told)
        made = attempt(folder, settings, places[at], skip, float(rng.uniform(0, typical[places[at]])))
        if made.status is not None:
            if made.status:
                wrong.append(f"the command ended with {made.status}, see {folder.with_suffix('.log')}")
            break
        lost = 0
        for run, (steps, saved) in made.steps.items():
            where = told.run_folder(*runs[run])
            if (where / "finished.json").exists():
                continue
            step = resumes_at(where)
            lost += max(0, steps - step)
            if step < saved:
                wrong.append(f"{run} had a checkpoint of step {saved} and goes on from {step}")
            if step not in (0, *cuts[run][-1:]):
                cuts[run].append(step)
        after = done(told)
        gone = [name for name, checksum in before.items() if after.get(name) != checksum]
        wrong += [f"{name} is gone or changed after a kill in phase {made.phase}" for name in gone]
        kills.append({"phase": made.phase, "run": made.run, "lost": lost, "results_lost": len(gone)})
    before = done(told)
    status = attempt(folder, settings).status
    if status:
        wrong.append(f"the command ended with {status}, see {folder.with_suffix('.log')}")
        return {"round": number, "kills": kills, "wrong": wrong}
    after = done(told)
    wrong += [f"{name} was made again" for name, checksum in before.items() if after.get(name) != checksum]
    for run, (arm, seed) in runs.items():
        # After its last checkpoint a run makes no step any more.
        points = tuple(step for step in cuts[run] if step < arm.total_steps)
        reference = folder.parent / "_".join(("cut", run, *map(str, points)))
        if not (reference / "left.json").exists():
            left = left_by(cut_off(reference, arm, seed, points))
            (reference / "left.json").write_text(json.dumps(left))
        expected = json.loads((reference / "left.json").read_text())
        found = left_by(told.run_folder(arm, seed))
        differ = sorted(k for k in expected.keys() | found.keys() if expected.get(k) != found.get(k))
        if differ:
            wrong.append(f"{run}, cut at {points}: other than a clean cut: {', '.join(differ)}")
    litter = [str(path.relative_to(folder)) for path in folder.rglob(".*") if path.name != ".lock"]
    wrong += [f"left behind: {name}" for name in litter]
    if not wrong:
        shutil.rmtree(folder)
    return {"round": number, "kills": kills, "wrong": wrong, "cuts": cuts}


def warm_up(folder: Path, settings: Sequence[str]) -> dict[tuple[str, str], float]:
    """Imports and compiles all that is needed, in this process; then how long each phase takes, s."""
    torch.set_num_threads(1)
    shutil.rmtree(folder, ignore_errors=True)
    for arm, seed in runs_of(told := read_experiment(folder, settings)).values():
        train_run(arm, seed, told.run_folder(arm, seed), QUIET)
        evaluate_run(arm, seed, told.run_folder(arm, seed), told.evaluation, told.evaluation_filter, QUIET)
    experiment.summarize_experiment(told)
    from safe_wrappers.train.report import write_report

    write_report(told, experiment.summarize_experiment(told))
    shutil.rmtree(folder)
    made = attempt(folder, settings)
    if made.status:
        raise RuntimeError(f"see {folder.with_suffix('.log')}")
    shutil.rmtree(folder)
    return {place: float(np.mean(seconds)) for place, seconds in made.seconds.items()}


def summary(rounds: list[dict[str, Any]], command: str) -> str:
    """What came of it, as a page."""
    kills = [kill for each in rounds for kill in each["kills"]]
    wrong = [line for each in rounds for line in each["wrong"]]
    counts = Counter(kill["phase"] for kill in kills)
    lines = [
        "# Kills of `compare`",
        "",
        f"`{command}`",
        "",
        "| Killed in | kills | steps made again: mean | most | results lost |",
        "|---|---|---|---|---|",
    ]
    for phase in (*PHASES, "all"):
        of = [kill for kill in kills if phase in (kill["phase"], "all")]
        if of:
            lost = [kill["lost"] for kill in of]
            results = sum(kill["results_lost"] for kill in of)
            lines.append(f"| {phase} | {len(of)} | {np.mean(lost):.0f} | {max(lost)} | {results} |")
    same = sum(not each["wrong"] for each in rounds)
    lines += [
        "",
        f"{sum(counts.values())} kills in {len(rounds)} comparisons; {same} of them came to an end with what clean"
        " cuts at the same checkpoints leave, bit for bit.",
        "",
        *(f"* {line}" for line in wrong),
    ]
    return "\n".join(lines).rstrip() + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--kills", type=int, default=120)
    parser.add_argument("--seeds", type=int, default=1, help="of each arm (default: %(default)s)")
    parser.add_argument("--workers", type=int, default=1, help="runs side by side (default: %(default)s)")
    parser.add_argument("--name", default="kills", help="of the results and of the folder in runs/")
    options = parser.parse_args()
    ctypes.CDLL(None).prctl(_SUBREAPER, 1, 0, 0, 0)  # orphans of a killed command are waited for here
    folder, path = Path("runs") / options.name, RESULTS / f"{options.name}.json"
    settings = f"seeds={list(range(options.seeds))}", f"workers={options.workers}"
    rounds: list[dict[str, Any]] = json.loads(path.read_text()) if path.exists() else []
    folder.mkdir(parents=True, exist_ok=True)
    typical = warm_up(folder / "undisturbed", settings)
    while sum(len(each["kills"]) for each in rounds) < options.kills:
        number = len(rounds)
        rounds.append(round_of_kills(number, folder / f"round_{number}", typical, settings))
        path.write_text("[\n" + ",\n".join(map(json.dumps, rounds)) + "\n]\n")
        print(rounds[-1], flush=True)
    given = " ".join(f"--{option} {value}" for option, value in vars(options).items())
    path.with_suffix(".md").write_text(summary(rounds, f"python -m benchmarks.kills {given}"))


if __name__ == "__main__":
    main()
