"""SafeRover under hard drivers, with the slip limiter on and off, and how far it takes to stop.

    python -m benchmarks.traction                    # 200,000 steps per driver; stopping distances; a car
    python -m benchmarks.traction --steps 2000       # a look
    python -m benchmarks.traction --config my.yaml   # whose unfiltered arm, seed 0, is the learned driver

Drivers: full throttle, panic brake, pulse, and a policy that PPO has learned without a limiter
(`safe-wrappers compare configs/saferover_ppo.yaml` trains it; without it that row is left out). Grounds: a base of
dry, wet or ice, by turns, with patches of water and ice. The judge is the env's own: a step counts as slipping if any
loaded wheel's slip was above 0.2 in size at the end of any physics substep, as a spin-out above 0.5, as a yaw
excursion if the yaw rate was more than 0.5 rad/s off what speed and steering ask for. SafeCarGoal's car stands on
MuJoCo's own friction; its wheels are judged at the ends of the control steps.
"""

import argparse
import importlib.util
import itertools
import math
import multiprocessing
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from scipy.optimize import minimize_scalar

import safe_wrappers as sw
from benchmarks.tables import RESULTS, keep, markdown, total

CONFIG = Path(__file__).parents[1] / "configs" / "saferover_ppo.yaml"
SLIPPING, YAW_EXCURSION = 0.2, 0.5
EPISODE_STEPS = 300
"""Three seconds: under full throttle the rover is out of the field soon after."""
GROUNDS = ("dry", "wet", "ice")
STOPPING_GROUNDS = ("dry", "wet", "snow", "ice")
START_SPEED = 3.0
STANDSTILL = 0.05
"""m/s."""

Driver = Callable[[Any, Any], Any]


@dataclass(frozen=True)
class Job:
    """One driver for so many steps."""

    driver: str
    limited: bool
    steps: int
    seed: int
    config: str


def drivers(raw: Any, rng: np.random.Generator) -> dict[str, Callable[[], Driver]]:
    """By name: what makes a driver of one episode, a function of observation and time step."""

    def steering() -> Callable[[int], float]:
        period, size = rng.uniform(0.4, 2.0), rng.uniform(0.0, 1.0)
        return lambda step: size * math.sin(math.tau * 0.01 * step / period)

    def full_throttle() -> Driver:
        steer = steering()
        return lambda _, step: np.array([1.0, 1.0, 1.0, 1.0, steer(step)])

    def panic_brake() -> Driver:
        steer, state = steering(), {"braking": False, "top": rng.uniform(1.0, 5.0)}

        def drive(_: Any, step: int) -> Any:
            speed = raw.forward_speed
            if speed > state["top"]:
                state["braking"] = True
            elif state["braking"] and speed < STANDSTILL:
                state["braking"], state["top"] = False, rng.uniform(1.0, 5.0)
            return np.array([*[-1.0 if state["braking"] else 1.0] * 4, steer(step)])

        return drive

    def pulse() -> Driver:
        steer, state = steering(), {"until": 0, "torque": np.ones(4)}

        def drive(_: Any, step: int) -> Any:
            if step >= state["until"]:
                state["until"] = step + int(rng.integers(3, 50))
                state["torque"] = rng.choice([-1.0, 0.0, 1.0], size=4 if rng.random() < 0.3 else 1)
            return np.array([*np.broadcast_to(state["torque"], 4), steer(step)])

        return drive

    return {"full throttle": full_throttle, "panic brake": panic_brake, "pulse": pulse}


def is_learned(config: str) -> bool:
    """Whether the config's unfiltered arm has been trained with its first seed (which takes SB3)."""
    if importlib.util.find_spec("stable_baselines3") is None:
        return False
    return (_run_folder(config)[1] / "finished.json").exists()


def _run_folder(config: str) -> tuple[Any, Path]:
    from safe_wrappers.train.config import parse_experiment, read_config

    experiment = parse_experiment(read_config(Path(config)))
    arm = next(a for a in experiment.arms if a.filter.kind == "none")
    return arm, experiment.run_folder(arm, experiment.seeds[0])


def _learned(config: str) -> Callable[[], Driver]:
    from safe_wrappers.train.run.policy import TrainedPolicy
    from safe_wrappers.train.run.training import finished_checkpoint

    arm, folder = _run_folder(config)
    policy = TrainedPolicy(arm, finished_checkpoint(arm, 0, folder))
    return lambda: lambda observation, _: policy(observation)


def run(job: Job) -> dict[str, Any]:
    """Drive, count."""
    env: Any = gym.make("SafeRover-v0", max_episode_steps=EPISODE_STEPS)
    raw = env.unwrapped
    if job.limited:
        env = sw.SlipLimiter(env, wheels=raw.wheels)
    rng = np.random.default_rng(job.seed)
    make = _learned(job.config) if job.driver == "learned" else drivers(raw, rng)[job.driver]
    count = dict.fromkeys(("slipping", "spin_out", "spin_outs_begun", "yaw", "intervened", "infeasible"), 0)
    distance, worst, done, episode, spun = 0.0, 0.0, True, 0, False
    for _ in range(job.steps):
        if done:
            ground = GROUNDS[episode % len(GROUNDS)]
            # A learned policy drives on what it has learned on.
            layout = (
                {} if job.driver == "learned" else {"ground": ground, "agent": [0.0, 0.0, rng.uniform(-3, 3)]}
            )
            observation, _ = env.reset(seed=1000 * job.seed + episode, options={"layout": layout})
            drive, step, episode, spun = make(), 0, episode + 1, False
        observation, _, terminated, truncated, info = env.step(drive(observation, step).astype(np.float32))
        step, done = step + 1, terminated or truncated
        spins = bool(info["spin_out"])
        count["slipping"] += info["slip_max"] > SLIPPING
        count["spin_out"] += spins
        count["spin_outs_begun"] += spins and not spun
        count["yaw"] += info["yaw_rate_error"] > YAW_EXCURSION
        if job.limited:
            count["intervened"] += info["cbf/intervened"]
            count["infeasible"] += info["cbf/infeasible"]
        spun, worst = spins, max(worst, info["slip_max"])
        distance += abs(raw.forward_speed) * raw.dt
    row = asdict(job) | {k: int(v) for k, v in count.items()} | {"worst_slip": float(worst)}
    row["mean_speed"] = distance / (job.steps * raw.dt)
    row["filter_us"] = 1e6 * env.filter_seconds / env.filter_calls if job.limited else None
    del row["config"]
    return row


def stopping_distance(ground: str, limited: bool) -> float:
    """Way to a standstill under a panic brake on one ground, m."""
    env: Any = gym.make("SafeRover-v0", max_episode_steps=10_000)
    raw = env.unwrapped
    if limited:
        env = sw.SlipLimiter(env, wheels=raw.wheels)
    _start(env, ground)
    brake = np.array([-1.0, -1.0, -1.0, -1.0, 0.0], dtype=np.float32)
    while raw.forward_speed > STANDSTILL:
        env.step(brake)
    return float(raw.agent_position[0])


def constant_slip_distance(ground: str, slip: float) -> float:
    """The same with all wheels held at one slip from the first moment on: the yardstick."""
    env: Any = gym.make("SafeRover-v0", max_episode_steps=100_000)
    raw = env.unwrapped
    raw.frame_skip = 1
    rates = [int(raw.model.joint(wheel).dofadr[0]) for wheel in raw.wheels]
    _start(env, ground)
    while raw.forward_speed > STANDSTILL:
        speed = raw.forward_speed
        # Below 0.5 m/s slip counts against that speed.
        raw.data.qvel[rates] = (speed - slip * max(speed, 0.5)) / raw.wheel_radius
        env.step(np.zeros(5, dtype=np.float32))
    return float(raw.agent_position[0])


def _start(env: Any, ground: str) -> None:
    layout = {"agent": [0.0, 0.0, 0.0], "goal": [4.0, 4.0], "hazards": [], "patches": []}
    env.reset(seed=0, options={"layout": layout | {"ground": ground, "speed": START_SPEED}})


def stopping_row(ground: str) -> dict[str, Any]:
    """All distances on one ground."""
    found = minimize_scalar(
        lambda s: constant_slip_distance(ground, s),
        bounds=(0.02, 0.5),
        method="bounded",
        options={"xatol": 2e-3},
    )
    return {
        "ground": ground,
        "unlimited_m": stopping_distance(ground, limited=False),
        "limited_m": stopping_distance(ground, limited=True),
        "best_constant_slip_m": float(found.fun),
        "best_slip": float(found.x),
    }


@dataclass(frozen=True)
class CarJob:
    """Pulses of full torque, both wheels alike or not, for so many steps."""

    limited: bool
    steps: int
    seed: int


def run_car(job: CarJob) -> dict[str, Any]:
    """Drive SafeCarGoal's car, count."""
    env: Any = gym.make("SafeCarGoal0-v0", max_episode_steps=EPISODE_STEPS)
    raw = env.unwrapped
    if job.limited:
        env = sw.SlipLimiter(env, wheels=["left", "right"])
    rng = np.random.default_rng(job.seed)
    slipping = spin_out = 0
    distance, done, episode, until, control = 0.0, True, 0, 0, np.zeros(2)
    for step in range(job.steps):
        if done:
            env.reset(seed=1000 * job.seed + episode)
            episode += 1
        if step >= until:
            until = step + int(rng.integers(3, 50))
            control = np.broadcast_to(rng.choice([-1.0, 1.0], size=2 if rng.random() < 0.3 else 1), 2)
        _, _, terminated, truncated, _ = env.step(control.astype(np.float32))
        done = terminated or truncated
        slip = max(_car_slip(raw, wheel) for wheel in ("left", "right"))
        slipping += slip > SLIPPING
        spin_out += slip > 0.5
        distance += math.hypot(*raw.data.qvel[:2]) * raw.dt
    return asdict(job) | {
        "slipping": int(slipping),
        "spin_out": int(spin_out),
        "mean_speed": distance / (job.steps * raw.dt),
    }


def _car_slip(raw: Any, wheel: str) -> float:
    """Size of a wheel's slip, from MuJoCo's own velocities of the wheel's geom."""
    velocity = np.zeros(6)
    geom = raw.model.geom(wheel)
    mujoco.mj_objectVelocity(raw.model, raw.data, mujoco.mjtObj.mjOBJ_GEOM, geom.id, velocity, 0)
    axle = raw.data.joint(wheel).xaxis
    ahead = np.cross(axle, [0.0, 0.0, 1.0])
    rim = float(geom.size[0]) * float(velocity[:3] @ axle)
    ground = float(velocity[3:] @ ahead) / float(np.linalg.norm(ahead))
    return abs(rim - ground) / max(abs(rim), abs(ground), 0.5)


def tables(rows: list[dict[str, Any]], stops: list[dict[str, Any]], cars: list[dict[str, Any]]) -> str:
    """Markdown."""
    driven: list[list[object]] = []

    def key(row: dict[str, Any]) -> tuple[str, bool]:
        return row["driver"], row["limited"]

    for (driver, limited), group in itertools.groupby(sorted(rows, key=key), key):
        part = list(group)
        steps = total(part, "steps")
        minutes = steps * 0.01 / 60.0
        speed = sum(r["mean_speed"] * r["steps"] for r in part) / steps
        cells = [driver, "on" if limited else "off", f"{steps:,}", f"{total(part, 'slipping') / steps:.2%}"]
        cells += [f"{total(part, 'spin_out') / steps:.3%}", f"{total(part, 'spin_outs_begun') / minutes:.1f}"]
        cells += [f"{total(part, 'yaw') / steps:.2%}", f"{max(r['worst_slip'] for r in part):.2f}"]
        acted = [f"{total(part, 'intervened') / steps:.1%}", total(part, "infeasible")]
        driven.append([*cells, f"{speed:.2f}", *(acted if limited else ["-", "-"])])
    head = "driver | limiter | steps | slip > 0.2 | spin-out | spin-outs / min | yaw excursion | worst slip"
    keys = ("unlimited_m", "limited_m", "best_constant_slip_m", "best_slip")
    stopped = [
        [
            s["ground"],
            *(f"{s[key]:.3f}" for key in keys),
            f"{s['limited_m'] / s['best_constant_slip_m']:.3f}",
        ]
        for s in stops
    ]
    pulsed = []
    for limited in (False, True):
        part = [c for c in cars if c["limited"] == limited]
        steps, speed = total(part, "steps"), float(np.mean([c["mean_speed"] for c in part]))
        shares = (f"{total(part, key) / steps:.2%}" for key in ("slipping", "spin_out"))
        pulsed.append([f"limiter {'on' if limited else 'off'}", f"{steps:,}", *shares, f"{speed:.2f}"])
    return "\n\n".join(
        [
            markdown(f"{head} | mean speed (m/s) | changed | infeasible", driven),
            markdown(
                "ground | limiter off (m) | limiter on (m) | best constant slip (m) | at slip | on / best",
                stopped,
            ),
            markdown("SafeCarGoal0, pulses | steps | slip > 0.2 | slip > 0.5 | mean speed (m/s)", pulsed),
        ]
    )


def main() -> None:
    """Run the jobs in parallel, print the tables, keep the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--steps", type=int, default=200_000, help="per driver, on and off each")
    parser.add_argument("--parts", type=int, default=4, help="independent runs per driver")
    parser.add_argument("--config", default=str(CONFIG), help="of the learned driver's training")
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    names = ["full throttle", "panic brake", "pulse"] + ["learned"] * is_learned(arguments.config)
    jobs = [
        Job(driver, limited, arguments.steps // arguments.parts, part, arguments.config)
        for driver, limited, part in itertools.product(names, (False, True), range(arguments.parts))
    ]
    with multiprocessing.get_context("spawn").Pool(arguments.workers) as pool:
        rows = pool.map(run, jobs, chunksize=1)
        stops = pool.map(stopping_row, STOPPING_GROUNDS, chunksize=1)
        part = arguments.steps // arguments.parts
        cars = pool.map(
            run_car,
            [CarJob(on, part, p) for on in (False, True) for p in range(arguments.parts)],
            chunksize=1,
        )
    found = {"drivers": rows, "stopping": stops, "car": cars}
    keep(RESULTS, "traction", found, tables(rows, stops, cars))


if __name__ == "__main__":
    main()
