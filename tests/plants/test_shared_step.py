"""The rollout of the executed control as the env's own step: the same bits, and only where it is the same step."""

import warnings

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.errors import ConfigurationError, UnsafeStateWarning

ENVS = (
    *(
        "HalfCheetah-v5",
        "Hopper-v5",
        "Walker2d-v5",
        "Swimmer-v5",
        "Ant-v5",
        "Humanoid-v5",
        "HumanoidStandup-v5",
    ),
    *("Reacher-v5", "Pusher-v5", "InvertedPendulum-v5", "InvertedDoublePendulum-v5"),
    *("SafeHopperVelocity-v0", "SafeAntVelocity-v0"),
)
NOT_SET = ("solver", "timer", "maxuse", "island", "efc_", "efm_", "map_", "iefc", "iM", "iL", "ifrc", "iacc")
"""Of MuJoCo's data: how the computation went, and arrays that these models leave uninitialised."""
SET = ("efc_force", "efc_aref", "efc_pos", "efc_state")


def filtered(env_id, **plant):
    recipe = sw.protect(gym.make(env_id))
    return sw.CBFActionFilter(gym.make(env_id), recipe.constraints, plant=sw.MujocoPlant(**plant))


def numbers(data):
    """Every array and number of MuJoCo's data."""
    found = {}
    for name in dir(data):
        value = None
        if not name.startswith("_") and (name in SET or not any(word in name for word in NOT_SET)):
            value = getattr(data, name)
        if isinstance(value, np.ndarray | int | float):
            found[name] = np.array(value)
    return found


@pytest.mark.parametrize("env_id", ENVS)
def test_the_shared_step_is_the_env_s_own_bit_for_bit(env_id):
    shared, own = filtered(env_id), filtered(env_id, share_step=False)
    space, rng = shared.action_space, np.random.default_rng(0)
    over, episode = True, 0
    with warnings.catch_warnings(action="ignore", category=UnsafeStateWarning):
        for t in range(150):
            if over:
                episode += 1
                shared.reset(seed=episode), own.reset(seed=episode)
            action = (rng.choice([0.2, 1.0]) * rng.uniform(space.low, space.high)).astype(space.dtype)
            one, two = shared.step(action), own.step(action)
            np.testing.assert_array_equal(one[0], two[0])
            assert one[1:4] == two[1:4]
            over = one[2] or one[3]
            for key, value in two[4].items():
                np.testing.assert_array_equal(one[4][key], value, err_msg=key)
            if t % 30 == 0:
                theirs = numbers(own.unwrapped.data)
                for name, value in numbers(shared.unwrapped.data).items():
                    np.testing.assert_array_equal(value, theirs[name], err_msg=name)
    taken_over = shared.plant.shared_steps
    assert own.plant.shared_steps == 0
    # The pendulum's constraint rolls nothing out.
    assert taken_over == 0 if env_id == "InvertedPendulum-v5" else taken_over > 50


@pytest.mark.parametrize("env_id", ["SafeHopperVelocity-v0", "Reacher-v5"])
def test_steps_that_the_filter_changes_are_shared_too(env_id):
    shared, own = filtered(env_id), filtered(env_id, share_step=False)
    rng, changed, over, low = np.random.default_rng(1), 0, True, shared.action_space.low
    for step in range(300):
        if over:
            shared.reset(seed=step), own.reset(seed=step)
        if step % 15 == 0:
            action = np.where(rng.random(low.size) < 0.5, low, -low)
        one, two = shared.step(action), own.step(action)
        np.testing.assert_array_equal(one[0], two[0])
        changed, over = changed + one[4]["cbf/intervened"], one[2] or one[3]
    assert changed > 20 and shared.plant.shared_steps > 290


class Pushed(gym.Wrapper):
    """Changes the state, the force or the control between the filter's decision and the simulation."""

    def __init__(self, env, what):
        super().__init__(env)
        self.what = what

    def step(self, action):
        data = self.unwrapped.data
        if self.what == "force":
            data.qfrc_applied[0] += 3.0
        elif self.what == "velocity":
            data.qvel[0] += 0.1
        else:
            inner = self.unwrapped.do_simulation
            self.unwrapped.do_simulation = lambda ctrl, n: inner(np.asarray(ctrl) * 0.5, n)
            try:
                return self.env.step(action)
            finally:
                del self.unwrapped.do_simulation
        return self.env.step(action)


@pytest.mark.parametrize("what", ["force", "velocity", "control"])
def test_a_step_that_is_not_what_was_rolled_out_is_simulated(what):
    limits = [sw.constraints.SpeedLimit(9.0, direction="+x")]
    one, two = (
        sw.CBFActionFilter(
            Pushed(gym.make("HalfCheetah-v5"), what), limits, plant=sw.MujocoPlant(share_step=share)
        )
        for share in (None, False)
    )
    one.reset(seed=0), two.reset(seed=0)
    for _ in range(20):
        action = one.action_space.sample()
        np.testing.assert_array_equal(one.step(action)[0], two.step(action)[0])
    assert one.plant.shared_steps == 0


def test_the_env_keeps_its_own_step():
    env = filtered("Hopper-v5")
    env.reset(seed=0)
    env.step(np.zeros(3, np.float32))
    assert env.plant.shared_steps == 1
    assert "_step_mujoco_simulation" not in vars(env.unwrapped)
    env.unwrapped.do_simulation(np.zeros(3), 4)
    with pytest.raises(ValueError, match="dimension"):
        env.unwrapped.do_simulation(np.zeros(2), 4)
    assert env.plant.shared_steps == 1


def test_who_watches_the_physics_steps_sees_all_of_them(monkeypatch):
    env, seen, step = filtered("Hopper-v5"), [0], mujoco.mj_step
    env.reset(seed=0)

    def watched(model, data, nstep=1):
        seen[0] += nstep * (data is env.unwrapped.data)
        step(model, data, nstep)

    with monkeypatch.context() as patched:
        patched.setattr(mujoco, "mj_step", watched)
        env.step(np.zeros(3, np.float32))
    assert seen[0] == env.unwrapped.frame_skip and env.plant.shared_steps == 0
    raw, own = env.unwrapped, []
    raw._step_mujoco_simulation = lambda ctrl, n: own.append(n)
    env.step(np.zeros(3, np.float32))
    assert own == [env.unwrapped.frame_skip] and "_step_mujoco_simulation" in vars(raw)


def heavier():
    model = gym.make("Hopper-v5").unwrapped.model
    spec = mujoco.MjModel.from_xml_path(gym.make("Hopper-v5").unwrapped.fullpath)
    spec.body_mass[:] = 1.1 * model.body_mass
    return spec


@pytest.mark.parametrize("other", ["model", "delay", "mass", "later mass"])
def test_a_plant_that_is_not_the_env_shares_nothing(other):
    plant = sw.MujocoPlant(
        model=heavier() if other == "model" else None, delay_s=0.008 if other == "delay" else 0.0
    )
    if other == "mass":
        plant.perturb(mass=1.1)
    env = sw.CBFActionFilter(gym.make("Hopper-v5"), [sw.constraints.SpeedLimit(9.0)], plant=plant)
    if other == "later mass":
        plant.perturb(mass=1.1)
    env.reset(seed=0)
    for _ in range(5):
        env.step(np.zeros(3, np.float32))
    assert plant.shared_steps == 0


def test_sharing_is_refused_where_it_cannot_be():
    for make in (
        lambda: (gym.make("Hopper-v5"), sw.MujocoPlant(delay_s=0.008, share_step=True)),
        lambda: (gym.make("SafePointGoal1-v0"), sw.MujocoPlant(share_step=True)),
    ):
        env, plant = make()
        with pytest.raises(ConfigurationError, match="share_step=True needs"):
            sw.CBFActionFilter(env, [sw.constraints.JointSpeedLimit(9.0)], plant=plant)


@pytest.mark.skipif(not hasattr(mujoco.mjtEnableBit, "mjENBL_SLEEP"), reason="in this MuJoCo nothing sleeps")
def test_nothing_is_shared_where_bodies_may_sleep():
    env = gym.make("Hopper-v5")
    env.unwrapped.model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
    sw.MujocoPlant().bind(env)  # an env that was measured
    with pytest.raises(ConfigurationError, match="no flag sleep"):
        sw.MujocoPlant(share_step=True).bind(env)


def test_an_env_that_nobody_measured_shares_on_request():
    class Own(gym.envs.mujoco.hopper_v5.HopperEnv):
        """The same robot from another module."""

    for share, count in ((None, 0), (True, 5)):
        plant = sw.MujocoPlant(share_step=share)
        env = sw.CBFActionFilter(Own(), [sw.constraints.SpeedLimit(9.0)], plant=plant)
        env.reset(seed=0)
        for _ in range(5):
            env.step(np.zeros(3, np.float32))
        assert plant.shared_steps == count
