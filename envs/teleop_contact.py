"""A tool pressed against a stiff wall and swept along it towards a clamp: the remote end of a teleoperation."""

import math
from collections.abc import Mapping
from typing import Any, Final

import mujoco
import numpy as np
from gymnasium.utils import EzPickle

from safe_wrappers.errors import Array, ConfigurationError
from safe_wrappers.info import COST, COST_SUBSTEP

from .field import METADATA, TaskEnv
from .layout import PLACE, Form, Given, parse_layout

WALL_X: Final = 0.2
"""Face of the wall, m: the tool's centre stays at smaller x."""
CLAMP_Y: Final = 0.25
"""Near face of the clamp, m: it must not be touched."""
TOOL_RADIUS: Final = 0.015
"""m."""
FORCE_LIMIT: Final = 40.0
"""N, of a contact."""
CLOSE_TO_CLAMP: Final = 0.03
"""Clearance at which the sweep is complete, m."""
TELEOP_BRAKING: Final = 24.0
"""m/s^2: what full reverse command takes off an approach speed at least, whatever the spring holds.

The damper gives 40 N against any approach at full reverse (its forcerange), the spring pulls on with 15 N at most,
and the tool has 1 kg: 25 m/s^2, less for what a last, partial step may lack."""
TELEOP_ACCELERATION: Final = 55.0
"""m/s^2: the most that any command may cause along an axis: 40 N of the damper, 15 N of the spring."""
TELEOP_TOP_SPEED: Final = 1.4
"""m/s: where damper and spring at their strongest balance, 40 (v - 1) = 15, rounded up."""

_SPRING_LIMIT: Final = 15.0  # N: beyond it the commanded position slips along
_PRESSING: Final = 0.5  # share of the wanted force within which a sweep counts
_SWEEP_REWARD: Final = 10.0  # per m
_START_X: Final = (0.0, 0.1)  # m
_START_Y: Final = (-0.05, 0.0)
_WANTED: Final = (6.0, 12.0)  # N
_FORMS: Final[dict[str, Form]] = {
    "tool": PLACE,
    "velocity": ("[vx, vy]", (2,)),
    "wanted_force": ("a number of N", ()),
}
_CAMERA: Final = {"distance": 0.9, "elevation": -90.0, "azimuth": 90.0, "lookat": np.array([0.1, 0.08, 0.0])}


class TeleopContactEnv(TaskEnv):
    """Press a tool against a wall with a wanted force, sweep it along the wall, stop before the clamp.

    The remote machine of a bilateral teleoperation, in the horizontal plane: a tool of 1 kg, a wall of 20 kN/m at
    x = 0.2 m, a clamp whose face is at y = 0.25 m. Physics, control and the cost run at 1 kHz: an action is held for
    one physics substep.

    **Action**: commanded velocity of the tool, m/s, ``Box(-1, 1, (2,), float32)``. A coupling drives the tool:
    a spring of 400 N/m from the commanded position (its integral) and a damper of 40 N s/m from the commanded
    velocity. The damper gives at most 40 N along an axis; at 15 N the spring slips: the commanded position is
    dragged along. Both make a saturated coupling that stores and dissipates energy, and generates none.

    **Observation**, float64, shape (9,): position (2, m) and velocity (2, m/s) of the tool, coupling force on the
    tool (2, N) at this state and the last command, normal force of the wall (N), clearance to the clamp (m), wanted
    force (N).

    **Port**: what a channel with wave coding has to know is published: the action is the port's flow, the
    observation's entries 4 and 5 its effort (`port_flow`, `port_effort_observed`); `port_effort` is the effort at the
    present state and last command, `port_feedthrough` by how much it changes per change of the flow (N s/m), and
    `port_effort_acted` what acted during the last step: this times the executed command times `dt` is the energy that
    the machine has absorbed at its port, exactly.

    **Reward**: per second, 1 less the relative error of the pressing force (0 at least); and 10 per metre of new
    sweep towards the clamp, made at half to one and a half times the wanted force, up to 3 cm before the clamp.

    **Info**, at every step and at reset: ``cost`` and its equal ``cost_substep`` (1.0 if the tool touched the clamp
    at the end of the step, which is one physics substep), ``cost_force`` (1.0 if a contact pushed with more than
    40 N), ``contact_force`` (N, of the wall), ``clearance`` (m, of the tool from the clamp, negative inside),
    ``swept`` (m, towards the clamp while it pressed, this episode).

    **Layout**: ``reset(options={"layout": {"tool": [x, y], "velocity": [vx, vy], "wanted_force": F}})``, any subset;
    place (0 to 0.1, -0.05 to 0 m) and wanted force (6 to 12 N) are sampled where they are not given, at rest.

    An episode never terminates; `gymnasium.make` truncates it after 6 s.

    Args:
        kwargs: Passed to `gymnasium.envs.mujoco.MujocoEnv` (``render_mode``, ``width``, ``camera_name``, ...).

    Example:
        >>> import gymnasium as gym, numpy as np, safe_wrappers
        >>> env = gym.make("TeleopContact-v0")
        >>> _ = env.reset(seed=0)
        >>> for _ in range(2500):
        ...     info = env.step(np.array([0.1, 0.0]))[4]
        >>> round(info["contact_force"], 1)  # the spring's limit and the damper
        19.0
    """

    metadata: dict[str, Any] = {**METADATA, "render_fps": 1000}  # noqa: RUF012 (Gymnasium's)

    port_flow: Final = (0, 1)
    """Entries of the action that are the port's flow."""
    port_effort_observed: Final = (4, 5)
    """Entries of the observation that are its effort."""
    wanted_force: float
    """N."""

    def __init__(self, **kwargs: Any) -> None:
        EzPickle.__init__(self, **kwargs)
        super().__init__("teleop_contact.xml", 1, 9, _CAMERA, **kwargs)
        model = self.model
        self._stiffness = float(model.tendon_stiffness.flat[0])
        self.port_feedthrough = float(model.actuator_gainprm[0, 0])
        self._damper_limit = float(model.actuator_forcerange[0, 1])
        self._wall = int(model.geom("wall").id)
        self.wanted_force = float(np.mean(_WANTED))
        self._begin()

    @property
    def tool_position(self) -> Array:
        """The tool's centre, shape (2,), m."""
        return np.array(self.data.qpos)

    @property
    def tool_velocity(self) -> Array:
        """Shape (2,), m/s."""
        return np.array(self.data.qvel)

    @property
    def clearance(self) -> float:
        """Between tool and clamp, m."""
        return CLAMP_Y - TOOL_RADIUS - float(self.data.qpos[1])

    @property
    def port_effort(self) -> Array:
        """Coupling force on the tool at the present state and the last command, shape (2,), N."""
        return np.array(self._coupling(self.data.ctrl))

    @property
    def port_effort_acted(self) -> Array:
        """Coupling force on the tool during the last step, shape (2,), N."""
        return np.array(self._acted)

    def _parse(self, options: Mapping[str, Any] | None) -> Given:
        given = parse_layout(options, _FORMS)
        if "wanted_force" in given and not 0.0 < given["wanted_force"] < _SPRING_LIMIT:
            raise ConfigurationError(
                f"wanted_force must be above 0 and below the spring's limit of {_SPRING_LIMIT} N; got "
                f"{float(given['wanted_force'])}"
            )
        if "tool" in given:
            x, y = given["tool"]
            if x + TOOL_RADIUS > WALL_X or y + TOOL_RADIUS > CLAMP_Y:
                raise ConfigurationError(
                    f"tool at {given['tool'].tolist()} m is inside the wall (x > {WALL_X - TOOL_RADIUS}) or "
                    f"the clamp (y > {CLAMP_Y - TOOL_RADIUS})"
                )
        return given

    def reset_model(self) -> Array:
        drawn = self.np_random.uniform(*np.transpose([_START_X, _START_Y, _WANTED]))
        self.wanted_force = float(self._given.get("wanted_force", drawn[2]))
        self.set_state(self._given.get("tool", drawn[:2]), self._given.get("velocity", np.zeros(2)))
        return self.observe()

    def set_state(self, qpos: Array, qvel: Array) -> None:
        """Set position and velocity of the tool (shapes (2,)), the coupling relaxed, and judge the state."""
        self.data.ctrl[:] = 0.0
        self.data.mocap_pos[0, :2] = qpos
        super().set_state(qpos, qvel)  # type: ignore[no-untyped-call]
        self._begin()

    def _is_finite(self, observation: Array) -> bool:
        return bool(np.isfinite(observation).all())

    def observe(self) -> Array:
        data = self.data
        tool = [*data.qpos.tolist(), *data.qvel.tolist(), *self._coupling(data.ctrl)]
        return np.array([*tool, self._force, self.clearance, self.wanted_force])

    def _get_reset_info(self) -> dict[str, Any]:
        cost = float(self.clearance <= 0.0)
        return {
            COST: cost,
            COST_SUBSTEP: cost,
            "cost_force": float(self._largest_force > FORCE_LIMIT),
            "contact_force": self._force,
            "clearance": self.clearance,
            "swept": self._swept,
        }

    def _step_mujoco_simulation(self, ctrl: Array, n_frames: int) -> None:
        model, data, ctrl = self.model, self.data, np.clip(ctrl, -1.0, 1.0)
        data.ctrl[:] = ctrl
        self._acted = self._coupling(ctrl)
        mujoco.mj_step(model, data, n_frames)
        self._advance_command(ctrl)
        self._read_contacts()

    def _advance_command(self, ctrl: Array) -> None:
        """Integrate the command; where the spring would pull with more than its limit, it slips."""
        place = self.data.mocap_pos[0]
        (ux, uy), (x, y) = ctrl.tolist(), self.data.qpos.tolist()
        dx, dy = place[0] + ux * self.dt - x, place[1] + uy * self.dt - y
        share = min(1.0, _SPRING_LIMIT / (self._stiffness * max(math.hypot(dx, dy), 1e-12)))
        place[0], place[1] = x + share * dx, y + share * dy

    def _coupling(self, ctrl: Array) -> list[float]:
        """Force of spring and damper on the tool, at the present state."""
        data, limit = self.data, self._damper_limit
        force = []
        for place, q, v, u in zip(
            data.mocap_pos[0].tolist(), data.qpos.tolist(), data.qvel.tolist(), ctrl.tolist(), strict=False
        ):
            damper = self.port_feedthrough * (u - v)
            force.append(self._stiffness * (place - q) + min(max(damper, -limit), limit))
        return force

    def _read_contacts(self) -> None:
        """Normal forces of the contacts in the step that was made, N: contacts without friction have one row each."""
        self._force = self._largest_force = 0.0
        data = self.data
        for i in range(data.ncon):
            contact = data.contact[i]
            if contact.efc_address < 0:
                continue
            force = float(data.efc_force[contact.efc_address])
            self._largest_force = max(self._largest_force, force)
            if self._wall in (contact.geom1, contact.geom2):
                self._force += force

    def _begin(self) -> None:
        self._acted = self._coupling(self.data.ctrl)
        self._read_contacts()
        self._swept = 0.0
        self._farthest = float(self.data.qpos[1])

    def _reward(self) -> float:
        error = abs(self._force - self.wanted_force) / self.wanted_force
        place = min(float(self.data.qpos[1]), CLAMP_Y - TOOL_RADIUS - CLOSE_TO_CLAMP)
        gained = place - self._farthest if error <= _PRESSING else 0.0
        if gained <= 0.0:
            return self.dt * max(1.0 - error, 0.0)
        self._farthest = place
        self._swept += gained
        return self.dt * max(1.0 - error, 0.0) + _SWEEP_REWARD * gained
