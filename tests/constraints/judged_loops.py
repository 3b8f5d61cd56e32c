"""Closed loops judged at every physics substep on data of their own, and the drivers that attack them."""

import mujoco
import numpy as np
from oracles import support_margin
from scenes import Scene

from safe_wrappers.plants.mujoco.contacts import Replay


def slider(strength=1.0, gear=1.0):
    """A mass of 1 kg on a slide along x, without gravity: `v' = gear u`, from -strength to strength."""
    return Scene(f"""<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody>
        <body name="b0"><joint name="x0" type="slide" axis="1 0 0"/><geom size=".1" mass="1"/></body></worldbody>
        <actuator><motor joint="x0" ctrlrange="{-strength} {strength}" gear="{gear}"/></actuator></mujoco>""")


HALF, HEIGHT, MASS = 0.2, 0.5, 5.0
TABLE = """<mujoco><option timestep="0.002" gravity="{gravity}"/>
<default><geom friction="2 0 0" solref="-40000 -200"/></default>
<worldbody><geom name="floor" type="plane" size="9 9 1"/>{step}
<body name="table" pos="0 0 {height}">
  <joint name="x" type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/><joint type="hinge" axis="0 1 0"/>
  <inertial pos="0 0 0" mass="{mass}" diaginertia=".3 .3 .3"/>{feet}</body></worldbody>
<actuator><motor joint="x" ctrllimited="true" ctrlrange="-1 1" gear="50"/></actuator></mujoco>"""
CORNERS = [(x, y) for x in (-HALF, HALF) for y in (-0.6, 0.6)]


def table(feet=CORNERS, step=0.0, gravity="0 0 -9.81"):
    """A table pushed at the height of its centre of mass; a control of 1 is 50 N."""
    legs = "".join(
        f'<geom name="f{i}" pos="{x} {y} {-HEIGHT + 0.02 + (step if x > 0 else 0.0)}" size=".02"/>'
        for i, (x, y) in enumerate(feet)
    )
    ground = f'<geom type="box" pos="1.1 0 {step - 0.5}" size="1 2 .5"/>' if step else ""
    return Scene(
        TABLE.format(height=HEIGHT, mass=MASS, feet=legs, step=ground, gravity=gravity), frame_skip=5
    )


def cart_before_a_wall(
    mass=5.0, stiffness=2e4, timestep=1e-3, gap=0.3, frame_skip=10, force=200.0, extra="", wall=""
):
    """A ball that is pushed along x towards a wall that MuJoCo makes a spring without damping."""
    env = Scene(
        f"""<mujoco><option timestep="{timestep}" gravity="0 0 0"/><worldbody>
        <body name="wall" pos="{gap + 0.1} 0 0" {wall}><geom name="wall" type="box" size=".05 .5 .5" pos=".05 0 0"
          condim="1" priority="1"/></body>
        <body name="cart"><joint name="x" axis="1 0 0" type="slide"/>
        <geom name="bumper" size=".1" mass="{mass}" condim="1"/></body>{extra}</worldbody>
        <actuator><motor joint="x" ctrlrange="-1 1" gear="{force}"/></actuator></mujoco>""",
        frame_skip=frame_skip,
    )
    env.model.geom("wall").solref[:] = -stiffness * env.model.body("cart").invweight0[0], 0.0
    env.model.geom("wall").solimp[:] = 1e-3, 1e-3, 1e-3, 0.5, 2.0
    return env


def flagged(info):
    """Whether the step says of itself that it promises nothing."""
    return info["cbf/infeasible"] or info["cbf/fallback"]


class Judge:
    """Integrates every executed action once more, from a copy of the env's data.

    Args:
        env: The filtered one, or a bare one.
        room: Model and data with fresh kinematics to what is left of the limit, any shape; wanted >= 0.
    """

    def __init__(self, env, room):
        self.raw, self.room = env.unwrapped, room
        self.data = mujoco.MjData(self.raw.model)
        self._still = mujoco.MjData(self.raw.model)

    def at(self, data):
        """Room of a state; MuJoCo's own derived quantities lag behind the state, these do not."""
        self._still.qpos[:], self._still.qvel[:] = data.qpos, data.qvel
        mujoco.mj_kinematics(self.raw.model, self._still)
        return float(np.min(self.room(self.raw.model, self._still)))

    def ahead(self, control, horizon):
        """Room after holding a control for some steps."""
        mujoco.mj_copyData(self.data, self.raw.model, self.raw.data)
        self.data.ctrl[:] = control
        mujoco.mj_step(self.raw.model, self.data, nstep=horizon * self.raw.frame_skip)
        return self.at(self.data)

    def step(self, env, action):
        """The least room at any substep of the step, that at its end, whether the episode ends, and the info."""
        mujoco.mj_copyData(self.data, self.raw.model, self.raw.data)
        *_, terminated, truncated, info = env.step(action)
        self.data.ctrl[:] = info.get("executed_action", action)
        rooms = []
        for _ in range(self.raw.frame_skip):
            mujoco.mj_step(self.raw.model, self.data)
            rooms.append(self.at(self.data))
        assert np.array_equal(self.data.qpos, self.raw.data.qpos)  # else it judges another machine
        assert np.array_equal(self.data.qvel, self.raw.data.qvel)
        return min(rooms), rooms[-1], terminated or truncated, info


class ForceJudge:
    """Likewise of forces, at every evaluation of the physics; of a state nothing is known before its step.

    Args:
        env: The filtered one, or a bare one.
        room: Model and data with the forces of the solver to what is left of the limit; wanted >= 0.
    """

    def __init__(self, env, room):
        self.raw, self.room = env.unwrapped, room
        self._replay = Replay(self.raw)

    def at(self, data):
        return 0.0

    def step(self, env, action):
        self._replay.before()
        *_, terminated, truncated, info = env.step(action)
        rooms = []
        assert self._replay.after(lambda data, _: rooms.append(self.room(self.raw.model, data)))
        return min(rooms), 0.0, terminated or truncated, info


# Rooms that need more than a line ----------------------------------------------------------------------------


def manipulability(model, data, kind, name, joints, directions="xyz"):
    """sqrt(det(J J')) by the singular values of MuJoCo's own Jacobian; positions are up to date."""
    mujoco.mj_comPos(model, data)
    linear = np.zeros((3, model.nv))
    index = getattr(model, kind)(name).id
    call = {"body": mujoco.mj_jacBody, "site": mujoco.mj_jacSite, "geom": mujoco.mj_jacGeom}[kind]
    call(model, data, linear, None, index)
    rows = [linear["xyz".index(d)] for d in directions]
    columns = model.jnt_dofadr[[model.joint(j).id for j in joints]]
    return float(np.prod(np.linalg.svd(np.array(rows)[:, columns], compute_uv=False)))


# Contact forces, from the numbers of MuJoCo's solver ----------------------------------------------------------


def moves(model, body):
    """Whether a body has a joint between itself and the world."""
    return model.body_treeid[body] >= 0


def touches(model, data):
    """Point, normal, force on the robot and friction of each contact with what does not move."""
    wrench = np.zeros(6)
    for k, contact in enumerate(data.contact):
        if contact.efc_address < 0 or -1 in contact.geom:
            continue
        one, two = (moves(model, model.geom_bodyid[g]) for g in contact.geom)
        if one != two:
            side, frame = (1.0 if two else -1.0), contact.frame.reshape(3, 3)
            mujoco.mj_contactForce(model, data, k, wrench)
            friction = min(contact.friction[:2]) if contact.dim > 1 else 0.0
            yield contact.pos.copy(), side * frame[0], side * frame.T @ wrench[:3], friction


def cone_room(share, tolerance=0.0):
    """By how much all contact forces stay in narrower cones, the tolerance added, shares of the weight."""

    def room(model, data):
        mass = sum(model.body_mass[b] for b in range(model.nbody) if moves(model, b))
        weight, left = mass * np.linalg.norm(model.opt.gravity), [np.inf]
        for _, normal, force, friction in touches(model, data):
            pressure = force @ normal
            sideways = np.linalg.norm(force - pressure * normal)
            left.append(min(share * friction * pressure - sideways, pressure) / weight)
        return min(left) + tolerance

    return room


def inside_the_hull(inset):
    """Distance of the zero moment point from the edge of the contacts' hull; infinite without one."""

    def room(model, data):
        found = list(touches(model, data))
        margin = support_margin(*(np.array([one[i] for one in found]).reshape(-1, 3) for i in range(3)))
        return np.inf if np.isnan(margin) else margin - inset

    return room


def below_force(limit):
    """What is left of a force, N, of all contacts together."""
    return lambda model, data: limit - float(data.efc_force[data.contact.efc_address[: data.ncon]].sum())


# Drivers: the judge, the action space, the number of the step, a generator ------------------------------------


def signs(space, k, rate):
    """Full controls that stay for `rate` steps."""
    bits = np.random.default_rng(k // rate).random(space.shape) < 0.5
    return np.where(bits, space.low, space.high)


def at_random(judge, space, k, rng):
    return rng.uniform(space.low, space.high)


def bang_bang(judge, space, k, rng):
    return signs(space, k, 9)


def full(judge, space, k, rng):
    return space.high


def noisy(judge, space, k, rng):
    """A weak policy: on legs it stands, falls and scrapes."""
    return 0.15 * space.high * rng.normal(size=space.shape).clip(-3, 3)


def seeking(judge, space, k, rng):
    """Of some full controls the one that leaves the least room two steps on."""
    tried = [np.where(rng.random(space.shape) < 0.5, space.low, space.high) for _ in range(5)]
    return min(tried, key=lambda u: judge.ahead(u, 2))


def drive(env, judge, driver, steps, seed=0):
    """Every step that starts safe and is not flagged has to keep the limit at every substep.

    Returns:
        Counts: intervened, flagged, outside (steps with less than no room), and the least room.
    """
    seen = {"intervened": 0, "flagged": 0, "outside": 0, "least": np.inf}
    rng = np.random.default_rng(seed)
    env.reset(seed=seed)
    before = judge.at(judge.raw.data)
    for k in range(steps):
        action = driver(judge, env.action_space, k, rng).astype(env.action_space.dtype)
        least, end, done, info = judge.step(env, action)
        # 1e-6: the executed action is rounded to the space's float32
        assert least >= -1e-6 or before < 0.0 or flagged(info), (k, least, info)
        seen["intervened"] += info["cbf/intervened"]
        seen["flagged"] += flagged(info)
        seen["outside"] += least < -1e-6
        seen["least"] = min(seen["least"], least)
        before = end
        if done:
            env.reset()
            before = judge.at(judge.raw.data)
    return seen
