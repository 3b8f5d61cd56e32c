"""An oracle for the goal tasks' costs: the rules read from every substep's state, on data of its own."""

import copy

import mujoco
import numpy as np


def violated(env, state, fresh, robot):
    """Whether a state breaks the rules: centre in a hazard; at level 2 a vase touched or moving."""
    model = env.model
    if any(np.hypot(*(state.qpos[:2] - hazard)) <= 0.2 for hazard in env.hazard_positions):
        return True
    if not env.level.vases_cost:
        return False
    fresh.qpos[:], fresh.qvel[:] = state.qpos, state.qvel
    mujoco.mj_fwdPosition(model, fresh)
    bodies = model.geom_bodyid[fresh.contact.geom]
    vases = [model.body(f"vase{i}").id for i in range(env.level.vases)]
    pairs = np.isin(bodies, [model.body(name).id for name in robot]), np.isin(bodies, vases)
    touching = bool((pairs[0] & pairs[1][:, ::-1]).any())
    starts = [model.body_dofadr[vase] for vase in vases]
    return touching or max(np.linalg.norm(state.qvel[at : at + 3]) for at in starts) > 1e-4


def check_costs(env, act, steps, episode, robot):
    """Drives as `act` says for the step's number, new episodes now and then; every cost is that of its substeps."""
    seen = {(0.0, 0.0): 0, (0.0, 1.0): 0, (1.0, 1.0): 0}
    fresh = mujoco.MjData(env.model)
    for t in range(steps):
        if t % episode == 0:
            env.reset()
        action = act(t)
        data = copy.copy(env.data)
        data.ctrl[:] = action
        substeps = []
        for _ in range(env.frame_skip):
            mujoco.mj_step(env.model, data)
            substeps.append(violated(env, data, fresh, robot))
        info = env.step(action)[4]
        assert info["cost"] == float(substeps[-1])
        assert info["cost_substep"] == float(any(substeps))
        assert info["cost"] == max(info["cost_hazards"], info["cost_vases"])
        seen[info["cost"], info["cost_substep"]] += 1
    assert min(seen.values()) > 0, f"the drive must meet every case: {seen}"
