"""The plant simulates the env's own model, whatever happens to it, and says so when the env does something else."""

import copy
import warnings

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.envs.mujoco.reacher_v5 import ReacherEnv
from scenes import make

import safe_wrappers as sw

ENVS = (
    *("HalfCheetah-v5", "Hopper-v5", "Ant-v5", "Humanoid-v5", "Reacher-v5", "InvertedPendulum-v5"),
    *("SafePointGoal2-v0", "SafeCarGoal1-v0", "SafeHopperVelocity-v0", "SafeRover-v0", "FlexJointReach-v0"),
)
ROBOTICS = ("FetchPush-v4", "PointMaze_UMaze-v3", "AntMaze_UMaze-v5", "HandReach-v3", "AdroitHandDoor-v1")
CHANGES = {
    "gravity": lambda m: m.opt.gravity.__imul__(0.4),
    "mass": lambda m: (m.body_mass.__imul__(1.3), m.body_inertia.__imul__(1.3)),
    "damping": lambda m: m.dof_damping.__imul__(1.3),
    "friction": lambda m: m.geom_friction.__imul__(0.5),
    "gear": lambda m: m.actuator_gear.__imul__(1.5),
    "wind": lambda m: (m.opt.wind.__iadd__(0.3), setattr(m.opt, "density", m.opt.density + 0.1)),
    "flags": lambda m: setattr(m.opt, "disableflags", int(mujoco.mjtDisableBit.mjDSBL_CONTACT)),
}


def driven(env, plan, actions=None):
    """Observations and infos of an env whose model changes at steps of the plan (-1: after the reset)."""
    rng, found = np.random.default_rng(0), [env.reset(seed=3)]
    for step in range(-1, 12):
        if step >= 0:
            # Weak, so that an unlucky change seldom ends the episode.
            weak = (0.4 * rng.uniform(-1, 1, env.action_space.shape)).astype(np.float32)
            observation, *_, info = env.step(actions[step] if actions else weak)
            found.append((observation, info))
        for change in plan.get(step, ()):
            CHANGES[change](env.unwrapped.model)
    return found


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("env_id", [*ENVS, *ROBOTICS])
def test_a_filtered_env_goes_on_with_its_own_model(env_id):
    """Bit for bit as the bare env under the same actions, and as was forecast, with every kind of change."""
    rng, kinds = np.random.default_rng(len(env_id)), list(CHANGES)
    if "Point" in env_id:  # its constraint refuses a machine that is no damped point
        kinds = ["mass", "gear", "gravity"]
    plan = {step: rng.choice(kinds, 2, replace=False) for step in (-1, 2, 7)}
    env = sw.protect(make(env_id))
    filtered = driven(env, plan)
    executed = [info["executed_action"].astype(env.action_space.dtype) for _, info in filtered[1:]]
    for (one, info), (two, _) in zip(filtered, driven(make(env_id), plan, executed), strict=True):
        theirs = two if isinstance(two, dict) else {"all": two}
        mine = one if isinstance(one, dict) else {"all": one}
        assert all(np.array_equal(mine[key], theirs[key]) for key in theirs)
        assert not info["cbf/mismatch"]
    if not any(word in env_id for word in ("Goal", "Rover", "Maze")):
        raw = env.unwrapped
        env.plant.observe()
        end = env.plant.rollout(executed[-1].astype(np.float64)).states[-1]
        raw.step(executed[-1])
        np.testing.assert_array_equal(end[: raw.model.nq], raw.data.qpos)


class Randomised(ReacherEnv):
    """Domain randomisation as it is usually written: the model is edited in place by every reset."""

    def __init__(self):
        super().__init__()
        self.own = copy.copy(self.model)

    def reset_model(self):
        gear, damping, armature = self.np_random.uniform(0.2, 1.0, 3)
        self.model.actuator_gear[:] = self.own.actuator_gear * gear
        self.model.dof_damping[:] = self.own.dof_damping + 0.5 * damping
        self.model.dof_armature[:] = self.own.dof_armature * (1.0 + 4.0 * armature)
        return super().reset_model()


def test_domain_randomisation_is_followed():
    raw = Randomised()
    env = sw.CBFActionFilter(raw, [sw.constraints.JointSpeedLimit(limit=5.0, joints=["joint0", "joint1"])])
    worst, corrected = 0.0, 0
    env.action_space.seed(0)
    for episode in range(8):
        env.reset(seed=episode)
        for step in range(50):
            if step % 10 == 0:
                action = np.sign(env.action_space.sample())
            info = env.step(action)[4]
            assert not info["cbf/mismatch"]
            if not (info["cbf/infeasible"] or info["cbf/fallback"]):
                worst = max(worst, np.abs(raw.data.qvel[:2]).max())
            corrected += info["cbf/intervened"]
    assert worst <= 5.0 + 1e-6 and corrected > 20


class Otherwise(gym.Wrapper):
    """Steps otherwise than it is told."""

    last = np.zeros(2, np.float32)

    def __init__(self, env, how):
        super().__init__(env)
        self.how = how

    def step(self, action):
        if self.how == "late":
            action, self.last = self.last, action
        elif self.how == "twice":
            self.env.step(action)
        elif self.how == "pushed":
            self.unwrapped.data.qvel[0] += 0.5
        elif self.how == "tired":
            self.unwrapped.model.actuator_gear[:, 0] *= 0.999
        return self.env.step(action)


SPEEDS = sw.constraints.JointSpeedLimit(limit=5.0, joints=["joint0", "joint1"])


SAYS = {
    "as told": "",
    "late": "applied",
    "twice": "instead of",
    "pushed": "from its forecast",
    "tired": "changed during",
}


@pytest.mark.parametrize("how", SAYS)
def test_a_step_that_is_not_the_one_that_was_judged_is_flagged(how):
    """No violation without a flag, and no flag without a reason."""
    env, told = sw.CBFActionFilter(Otherwise(gym.make("Reacher-v5").unwrapped, how), [SPEEDS]), SAYS[how]
    env.reset(seed=0)
    flags, rng = 0, np.random.default_rng(0)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(60):
            action = np.sign(rng.uniform(-1, 1, env.action_space.shape)).astype(np.float32)
            info = env.step(action)[4]
            flags += info["cbf/mismatch"]
            broken = np.abs(env.unwrapped.data.qvel[:2]).max() > 5.0 + 1e-6
            assert not broken or info["cbf/mismatch"] or info["cbf/infeasible"] or info["cbf/unsafe"]
    warned = [str(w.message) for w in caught if "cbf/mismatch" in str(w.message)]
    assert (flags > 10 and len(warned) == 1 and told in warned[0]) if told else not (flags or warned)


def test_a_model_that_is_made_anew_is_followed():
    """As envs do whose robot is compiled for every episode."""
    env = sw.CBFActionFilter(gym.make("Hopper-v5"), [sw.constraints.SpeedLimit(9.0)])
    raw = env.unwrapped
    env.reset(seed=0)
    raw.model = gym.make("Hopper-v5").unwrapped.model
    raw.model.body_mass[:] *= 1.1
    raw.data = mujoco.MjData(raw.model)
    env.reset(seed=1)
    for _ in range(5):
        info = env.step(np.full(3, 0.5, np.float32))[4]
        assert not info["cbf/mismatch"] and env.plant.model is raw.model
    raw.model = gym.make("Walker2d-v5").unwrapped.model
    for _ in range(2):
        with pytest.raises(sw.SafeWrappersError, match=r"another machine: expected .* build the filter anew"):
            env.plant.observe()


def test_a_simulation_follows_the_model_of_its_env():
    """Gravity, mass and motors that change in mid-episode are those of the next rollout."""
    raw = gym.make("Reacher-v5")
    shield = sw.constraints.PredictiveShield(lambda x: 30.0 - np.abs(x[6:8]).max(), horizon=2, backup="zero")
    env = sw.CBFActionFilter(raw, [shield], plant=sw.SimulatorPlant(check_steps=20))
    env.reset(seed=0)
    for step, change in enumerate(["gear", "mass", "gravity", "damping"] * 3):
        CHANGES[change](env.unwrapped.model)
        action = np.full(2, (-1.0) ** step, np.float32)
        foreseen = env.plant.rollout(action.astype(float), 1).observations[0]
        observation, *_, info = env.step(action)
        np.testing.assert_array_equal(foreseen, observation)
        assert not info["cbf/mismatch"] and not info["cbf/intervened"]


def test_a_machine_that_has_become_unfit_is_refused_from_the_next_comparison_on_every_time():
    damped = sw.protect(make("SafePointGoal1-v0"))
    damped.reset(seed=0)
    damped.unwrapped.model.dof_damping[0] *= 2.0
    clamped = sw.CBFActionFilter(gym.make("Reacher-v5"), [SPEEDS])
    clamped.reset(seed=0)
    # Of a joint whose motors MujocoPlant cannot write as f + g u: compared at resets alone.
    clamped.unwrapped.model.jnt_actfrclimited[0] = True
    clamped.step(np.zeros(2, np.float32))
    for _ in range(2):
        with pytest.raises(sw.SafeWrappersError, match="the slides need equal damping"):
            damped.step(np.zeros(2, np.float32))
        with pytest.raises(sw.SafeWrappersError, match="clamps the sum of its actuators' forces"):
            clamped.reset(seed=1)
