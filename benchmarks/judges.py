"""Who says what a violation is: each env's truth, on the env's own model, with no code of a constraint in it.

A judge looks at the env before and after each step and answers by how much the requirement was missed, in the
requirement's own unit: above 0, or not a number, is a violation.
"""

from collections.abc import Callable
from typing import Any, Final, Protocol

import gymnasium as gym
import mujoco
import numpy as np

Truth = Callable[[mujoco.MjData], float]
"""By how much a state misses a requirement; the positions of bodies are up to date."""

FLAGS: Final = ("intervened", "infeasible", "fallback", "unsafe")
"""What a filter says of a step, as `cbf/...` in info."""

_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)


class Judge(Protocol):
    """What says whether a step broke the requirement."""

    def start(self) -> float:
        """By how much the env's present state, of a reset, misses it; 0 where steps alone are judged."""
        return 0.0

    def before(self) -> None:
        """Called before each step."""

    def after(self, executed: np.ndarray, info: dict[str, Any]) -> float:
        """By how much the step missed it: what the env was given, and the info that it returned."""


class Judged(gym.Wrapper[Any, Any, Any, Any]):
    """Writes what a judge says of every step into info, in place of the task's own cost."""

    def __init__(self, env: gym.Env[Any, Any], judge: Judge) -> None:
        super().__init__(env)
        self._judge = judge

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        found = self.env.reset(**options)
        self._judge.start()
        return found

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """One control step, judged."""
        self._judge.before()
        observation, reward, terminated, truncated, info = self.env.step(action)
        missed = self._judge.after(info.get("executed_action", action), info)
        verdict = float(not missed <= 0.0)  # what is not a number is a violation
        return observation, reward, terminated, truncated, info | {"cost": verdict, "cost_substep": verdict}


def counted(info: dict[str, Any], violated: bool) -> dict[str, int]:
    """What a step adds to counts: its flags, a violation, and one that no flag but "intervened" came with.

    Without a filter there are no flags, and nothing that is unflagged.
    """
    found = {name: int(info.get(f"cbf/{name}", False)) for name in FLAGS}
    silent = "cbf/infeasible" in info and not any(found[name] for name in FLAGS[1:])
    return found | {"violations": int(violated), "unflagged": int(violated and silent)}


class Replay(Judge):
    """Makes every step once more on data of its own and evaluates a truth after each physics substep.

    Args:
        env: Unwrapped.
        truth: Evaluated on the states.
        prepare: What the env does to its data at the start of a step, before it sets the control.
        control: The control that the env makes of an action; None: the action itself.
        reported: By how much the info of a step says that the env misses something else, whose sign counts.

    Raises:
        RuntimeError: The replay does not end in the env's own state, bit for bit.
    """

    def __init__(
        self,
        env: Any,
        truth: Truth,
        prepare: Callable[[mujoco.MjModel, mujoco.MjData], None] | None = None,
        control: Callable[[np.ndarray], np.ndarray] | None = None,
        reported: Callable[[dict[str, Any]], float] = lambda info: -np.inf,
    ) -> None:
        self._env, self._truth, self._prepare, self._control = env, truth, prepare, control
        self._reported = reported
        self._model: mujoco.MjModel = env.model
        self._data = mujoco.MjData(self._model)
        self._state = np.zeros(mujoco.mj_stateSize(self._model, _STATE))

    def start(self) -> float:
        self.before()
        mujoco.mj_setState(self._model, self._data, self._state, _STATE)
        return self._present()

    def before(self) -> None:
        """Keep the state that the step starts from."""
        mujoco.mj_getState(self._model, self._env.data, self._state, _STATE)

    def after(self, executed: np.ndarray, info: dict[str, Any]) -> float:
        """The worst of the step's substeps."""
        model, data = self._model, self._data
        mujoco.mj_setState(model, data, self._state, _STATE)
        if self._prepare is not None:
            self._prepare(model, data)
        there = self._env.data
        data.ctrl[:] = executed if self._control is None else self._control(executed)
        missed = [self._reported(info)]
        for _ in range(round((there.time - data.time) / model.opt.timestep)):
            mujoco.mj_step(model, data)
            missed.append(self._present())
        if not (np.array_equal(data.qpos, there.qpos) and np.array_equal(data.qvel, there.qvel)):
            raise RuntimeError(
                "the replayed step does not end where the env's did: this judge would be wrong"
            )
        return float(np.max(missed))

    def _present(self) -> float:
        # mj_step leaves the poses of the state before. The next one computes them anew: nothing is disturbed.
        mujoco.mj_kinematics(self._model, self._data)
        return self._truth(self._data)


class Reported(Judge):
    """Reads what the task itself reports of a step.

    Args:
        missed: By how much the info of a step misses the requirement.
    """

    def __init__(self, missed: Callable[[dict[str, Any]], float]) -> None:
        self._missed = missed

    def after(self, executed: np.ndarray, info: dict[str, Any]) -> float:
        return self._missed(info)


def stepped(env: Any) -> Any:
    """The env that steps the physics: this one, or the robot that a maze holds."""
    return next(e for e in (env, *vars(env).values()) if hasattr(e, "frame_skip"))


def onto_ranges(model: mujoco.MjModel) -> Callable[[np.ndarray], np.ndarray]:
    """Actions in [-1, 1] put onto the actuators' ranges, as the hands do."""
    low, high = model.actuator_ctrlrange.T
    return lambda action: (low + high) / 2.0 + action * ((high - low) / 2.0)


def any_of(*truths: Truth) -> Truth:
    """Several requirements at once: the worst of them."""
    return lambda data: max(truth(data) for truth in truths)


def joint_beyond(model: mujoco.MjModel, joint: str, limit: float) -> Truth:
    """A joint farther than `limit` (m or rad) from its zero, on either side."""
    address = int(model.joint(joint).qposadr[0])
    return lambda data: abs(float(data.qpos[address])) - limit


def joint_above(model: mujoco.MjModel, joint: str, limit: float) -> Truth:
    """A joint above `limit`, m or rad."""
    address = int(model.joint(joint).qposadr[0])
    return lambda data: float(data.qpos[address]) - limit


def joints_too_fast(
    model: mujoco.MjModel, limit: float, slides: float = np.inf, also: tuple[str, ...] = ()
) -> Truth:
    """A joint with a motor, or one of those named, faster than `limit`, rad/s; a slide than `slides`, m/s."""
    motors = np.isin(model.actuator_trntype, int(mujoco.mjtTrn.mjTRN_JOINT))
    joints = [*model.actuator_trnid[motors, 0], *(model.joint(name).id for name in also)]
    dofs = model.jnt_dofadr[joints]
    limits = np.where(model.jnt_type[joints] == int(mujoco.mjtJoint.mjJNT_SLIDE), slides, limit)
    return lambda data: float((np.abs(data.qvel[dofs]) - limits).max())


def inside_disc(model: mujoco.MjModel, body: str, center: tuple[float, float], radius: float) -> Truth:
    """A body's origin inside an upright cylinder, m."""
    index, middle = model.body(body).id, np.array(center)
    return lambda data: radius - float(np.linalg.norm(data.xpos[index, :2] - middle))


def outside_box(model: mujoco.MjModel, body: str, low: tuple[float, ...], high: tuple[float, ...]) -> Truth:
    """A body's origin outside a box, m."""
    index, least, most = model.body(body).id, np.array(low), np.array(high)

    def truth(data: mujoco.MjData) -> float:
        place = data.xpos[index]
        return float(max((least - place).max(), (place - most).max()))

    return truth


def touches_wall(model: mujoco.MjModel, geom: str) -> Truth:
    """A geom in contact with a box of the world: 1 if MuJoCo reports it (from the contact margin on), else -1."""
    own, walls = model.geom(geom).id, set(wall_geoms(model).tolist())

    def truth(data: mujoco.MjData) -> float:
        mujoco.mj_collision(model, data)
        pairs = data.contact.geom[: data.ncon].tolist()
        return 1.0 if any((a == own and b in walls) or (b == own and a in walls) for a, b in pairs) else -1.0

    return truth


def near_wall(model: mujoco.MjModel, body: str, distance: float) -> Truth:
    """A body's origin closer than `distance` to a box of the world, seen from above, m."""
    index, geoms = model.body(body).id, wall_geoms(model)
    middle, half = model.geom_pos[geoms, :2], model.geom_size[geoms, :2]

    def truth(data: mujoco.MjData) -> float:
        beyond = np.maximum(np.abs(data.xpos[index, :2] - middle) - half, 0.0)
        return distance - float(np.sqrt((beyond**2).sum(axis=1)).min())

    return truth


def wall_geoms(model: mujoco.MjModel) -> np.ndarray:
    """Indices of the boxes that stand in the world."""
    return np.flatnonzero((model.geom_bodyid == 0) & (model.geom_type == int(mujoco.mjtGeom.mjGEOM_BOX)))


def faster_than(limit: float, plane: bool) -> Callable[[dict[str, Any]], float]:
    """The published speed of a step, displacement over time along x or in the plane, above `limit`, m/s."""

    def missed(info: dict[str, Any]) -> float:
        x = float(info["x_velocity"])
        return (float(np.hypot(x, info["y_velocity"])) if plane else x) - limit

    return missed


def costs(info: dict[str, Any]) -> float:
    """A cost at some physics substep, as the task judges itself: 1 or -1."""
    return 1.0 if info["cost_substep"] else -1.0


def clip_speed(limit: float) -> Callable[[mujoco.MjModel, mujoco.MjData], None]:
    """What PointMaze does at the start of a step: no velocity beyond `limit`, and all derived quantities anew."""

    def prepare(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        data.qvel[:] = np.clip(data.qvel, -limit, limit)
        mujoco.mj_forward(model, data)

    return prepare
