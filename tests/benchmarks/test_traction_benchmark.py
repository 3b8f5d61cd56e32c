"""The traction table: its counts against a rover driven by hand, its stopping distances against the physics."""

import json
import sys

import gymnasium as gym
import numpy as np
import pytest

from benchmarks import traction
from benchmarks.traction import (
    START_SPEED,
    CarJob,
    Job,
    constant_slip_distance,
    drivers,
    run,
    run_car,
    stopping_distance,
    tables,
)
from safe_wrappers.envs.ground import MAGIC_FORMULA

HARD = ("full throttle", "panic brake", "pulse")
G = 9.81


def job(driver="full throttle", limited=True, steps=60, seed=0):
    return Job(driver, limited, steps, seed, "no such file")


@pytest.mark.parametrize("driver", HARD)
def test_the_limiter_keeps_the_wheels_from_spinning(driver):
    off, on = (run(job(driver, limited)) for limited in (False, True))
    assert off["slipping"] > 0.8 * 60 and off["spin_out"] > 0.5 * 60 and off["spin_outs_begun"] >= 1
    assert on["slipping"] <= 3 and on["spin_out"] == on["spin_outs_begun"] == 0
    assert on["worst_slip"] < off["worst_slip"]
    assert on["intervened"] > 30 and on["infeasible"] == 0 and on["filter_us"] > 0.0
    assert off["intervened"] == 0 and off["filter_us"] is None
    assert run(job(driver)) | {"filter_us": 0} == on | {"filter_us": 0}  # the same every time


def test_counts_are_the_envs_own():
    row = run(job(limited=False, steps=40))
    env = gym.make("SafeRover-v0")
    rng = np.random.default_rng(0)
    make = drivers(env.unwrapped, rng)["full throttle"]
    env.reset(seed=0, options={"layout": {"ground": "dry", "agent": [0.0, 0.0, rng.uniform(-3, 3)]}})
    drive, speeds, infos = make(), [], []
    for step in range(40):
        infos.append(env.step(drive(None, step).astype(np.float32))[4])
        speeds.append(abs(env.unwrapped.forward_speed))
    assert row["slipping"] == sum(info["slip_max"] > 0.2 for info in infos)
    assert row["spin_out"] == sum(info["spin_out"] for info in infos)
    assert row["yaw"] == sum(info["yaw_rate_error"] > 0.5 for info in infos)
    assert row["worst_slip"] == max(info["slip_max"] for info in infos)
    assert row["mean_speed"] == pytest.approx(np.mean(speeds))


def test_the_cars_wheels_slip_less_with_the_limiter():
    off, on = (run_car(CarJob(limited, 200, seed=0)) for limited in (False, True))
    assert on["slipping"] < 0.5 * off["slipping"]
    assert off["spin_out"] <= off["slipping"] <= off["steps"] == 200
    assert on["mean_speed"] > 0.1


@pytest.mark.parametrize("ground", ["dry", "snow"])
def test_stopping_distances_are_the_physics(ground):
    top = MAGIC_FORMULA[ground]
    best = START_SPEED**2 / (2.0 * top.peak_friction * G)
    at_peak = constant_slip_distance(ground, top.peak_slip)
    assert at_peak == pytest.approx(best, rel=0.03)
    # Locked wheels slide on what is left of the friction behind the peak.
    locked = START_SPEED**2 / (2.0 * MAGIC_FORMULA[ground].at(1.0) * G)
    assert constant_slip_distance(ground, 0.99) == pytest.approx(locked, rel=0.05)
    assert at_peak < stopping_distance(ground, limited=True) < 1.1 * at_peak
    assert stopping_distance(ground, limited=False) > 1.2 * at_peak


def test_the_command_prints_every_driver_and_ground_and_keeps_the_rows(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(traction, "RESULTS", tmp_path)
    monkeypatch.setattr(traction, "STOPPING_GROUNDS", ("dry",))
    monkeypatch.setattr(traction, "is_learned", lambda config: False)

    class Here:
        """Instead of a pool of processes, in which nothing of the above would hold."""

        def __init__(self, workers):
            pass

        def __enter__(self):
            return self

        def __exit__(self, *error):
            pass

        def map(self, function, jobs, chunksize):
            return [function(job) for job in jobs]

    monkeypatch.setattr(
        traction.multiprocessing, "get_context", lambda kind: type("Context", (), {"Pool": Here})
    )
    monkeypatch.setattr(sys, "argv", ["traction", "--steps", "40", "--parts", "2"])
    traction.main()
    printed = capsys.readouterr().out
    kept = json.loads((tmp_path / "traction.json").read_text())
    assert (tmp_path / "traction.md").read_text().strip() == printed.strip()
    assert len(kept["drivers"]) == len(HARD) * 2 * 2
    for driver in HARD:
        for arm in ("off", "on"):
            assert f"| {driver} | {arm} | 40 |" in printed
    assert len(kept["car"]) == 2 * 2 and "| limiter on | 40 |" in printed
    assert [row["ground"] for row in kept["stopping"]] == ["dry"]
    assert kept["stopping"][0]["best_slip"] == pytest.approx(MAGIC_FORMULA["dry"].peak_slip, abs=0.03)


def test_parts_of_a_driver_are_added_up():
    one = run(job(limited=False, steps=20))
    car = {"limited": False, "steps": 10, "slipping": 5, "spin_out": 1, "mean_speed": 1.0}
    many = [one | {"seed": seed, "worst_slip": float(seed)} for seed in range(3)]
    lines = tables(many, [], [car, car | {"limited": True}]).splitlines()
    line = next(line for line in lines if line.startswith("| full throttle | off"))
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    assert cells[2] == "60"
    assert cells[3] == f"{one['slipping'] / 20:.2%}"
    assert cells[7] == "2.00"
