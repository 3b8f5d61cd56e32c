"""Each file of a run's folder damaged in turn: it is made again or refused by its name, and no number changes."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from safe_wrappers.errors import RunStateError
from safe_wrappers.train.config import parse_experiment
from safe_wrappers.train.config.file import read_config
from safe_wrappers.train.evaluation.evaluate import evaluate_run
from safe_wrappers.train.evaluation.summary import summarize
from safe_wrappers.train.experiment import write_cards
from safe_wrappers.train.processes.job import Progress
from safe_wrappers.train.run import train_run, training
from safe_wrappers.train.videos.record import load_video

QUIET = Progress(lambda _: None, lambda _: None)
DAMAGES = {
    "half": lambda data: data[: len(data) // 2],
    "empty": lambda data: b"",
    "noise": lambda data: np.random.default_rng(0).bytes(len(data)),
}
SMALL = ("seeds=[0]", "total_steps=384", "evaluation.episodes=2")
ALONE = "arms={filtered: {filter: {factory: 'fake_task:shield', kwargs: {margin: 0.02}}}}"


class Killed(BaseException):
    """Stands for the end of the process."""


def read(output):
    fake = Path(__file__).parent / "fake.yaml"
    return parse_experiment(read_config(fake, [f"output={output}", *SMALL, ALONE]))


def run_of(experiment):
    return experiment.run_folder(experiment.arms[0], 0)


def restart(experiment):
    """What `compare` does, but for films and the page, in this process."""
    arm, folder = experiment.arms[0], run_of(experiment)
    train_run(arm, 0, folder, QUIET)
    write_cards(experiment)
    evaluate_run(arm, 0, folder, experiment.evaluation, experiment.evaluation_filter, QUIET)
    write_cards(experiment)


def numbers(experiment):
    """All that an experiment says, but for wall clock times."""
    found = {"summary": repr(summarize(experiment))}
    folder = run_of(experiment)
    for path in (*folder.glob("*.csv"), *folder.glob("*/*.csv"), *folder.glob("policy/*.json")):
        found[path.name] = path.read_bytes()
    for path in folder.glob("*/*.npz"):
        with np.load(path) as arrays:
            for name in arrays.files:
                if name != "filter_time_us":
                    found[f"{path}/{name}"[len(str(folder)) :]] = arrays[name].tobytes()
    return found


def damaged(whole, tmp_path):
    """Copies of an experiment with one file damaged each: which, how, and the experiment."""
    for path in sorted(path.relative_to(whole) for path in whole.rglob("*") if path.is_file()):
        for how, damage in DAMAGES.items():
            shutil.rmtree(tmp_path / "copy", ignore_errors=True)
            shutil.copytree(whole, tmp_path / "copy")
            (tmp_path / "copy" / path).write_bytes(damage((whole / path).read_bytes()))
            yield path, how, read(tmp_path / "copy")


def test_of_a_finished_run(tmp_path):
    experiment = read(tmp_path / "whole")
    restart(experiment)
    expected = numbers(experiment)
    finished = (run_of(experiment) / "finished.json").read_bytes()
    refused, made_again, files = set(), set(), 0
    for path, how, copy in damaged(tmp_path / "whole", tmp_path):
        files += 1
        try:  # what `report` reads
            assert repr(summarize(copy)) == expected["summary"], (path, how)
        except RunStateError as error:
            assert path.name in str(error), (path, how, error)
        try:
            restart(copy)
        except RunStateError as error:
            assert path.name in str(error) and "delete" in str(error), (path, how, error)
            refused.add(path.parent.name if path.parent.parent.name == "checkpoints" else path.name)
            continue
        assert numbers(copy) == expected, (path, how)
        assert (run_of(copy) / "finished.json").read_bytes() == finished, (path, how)  # times and all
        made_again.add(path.name)
    assert files >= 3 * 18
    # The last checkpoint and the settings are all that a finished run cannot do without.
    assert refused == {"run.json", "step_000000000384"}
    assert {"episodes.csv", "finished.json", "filter_on.csv", "model.npz", "config.json"} <= made_again


def test_of_a_run_that_was_killed(tmp_path, monkeypatch):
    save, saved = training.save_checkpoint, []

    def saving(*given, **named):
        saved.append(save(*given, **named))
        if len(saved) == 2:
            raise Killed
        return saved[-1]

    experiment = read(tmp_path / "whole")
    with monkeypatch.context() as patch:
        patch.setattr(training, "save_checkpoint", saving)
        with pytest.raises(Killed):
            restart(experiment)
    expected = []
    for gone in ((), saved[1:]):  # from the last checkpoint, and from the one before
        copy = read(tmp_path / f"without_{len(gone)}")
        shutil.copytree(tmp_path / "whole", copy.output)
        for folder in gone:
            shutil.rmtree(copy.output / folder.relative_to(tmp_path / "whole"))
        restart(copy)
        expected.append(numbers(copy))
    assert expected[0] != expected[1]
    went_on = {0: set(), 1: set()}
    for path, how, copy in damaged(tmp_path / "whole", tmp_path):
        try:
            restart(copy)
        except RunStateError as error:
            assert path.name == "run.json" in str(error) and "delete" in str(error), (path, how, error)
            continue
        found = numbers(copy)
        assert found in expected, (path, how)
        went_on[expected.index(found)].add(path.parts[-2:])
    assert {parts[0] for parts in went_on[1]} == {saved[1].name}
    assert ("seed_0", "episodes.csv") in went_on[0]


def test_without_a_checkpoint_a_finished_run_is_not_begun_again(tmp_path):
    experiment = read(tmp_path)
    restart(experiment)
    table = run_of(experiment) / "episodes.csv"
    shutil.rmtree(run_of(experiment) / "checkpoints")
    train_run(experiment.arms[0], 0, run_of(experiment), QUIET)  # whole: somebody made room
    table.write_text("")
    with pytest.raises(RunStateError, match=r"episodes\.csv is not .*, and no checkpoint is left .*; delete"):
        train_run(experiment.arms[0], 0, run_of(experiment), QUIET)
    assert table.read_text() == ""


def test_a_damaged_film_is_not_shown(tmp_path):
    import json

    from safe_wrappers.train.checksums import checksums

    path = tmp_path / "a_filter_on.webp"
    path.write_bytes(b"frames")
    shown = {"title": "typical", "steps": 1, "changed": 0}
    facts = {"speed": 1.0, "episodes": [shown], "files": checksums([path])}
    path.with_suffix(".json").write_text(json.dumps(facts))
    assert load_video(path).animation == b"frames"
    for name in (path, path.with_suffix(".json")):
        whole = name.read_bytes()
        for damage in DAMAGES.values():
            name.write_bytes(damage(whole))
            assert load_video(path) is None
        name.write_bytes(whole)
