"""Old names of parameters and methods: they work, warn once, and say the new ones."""

import inspect
import warnings
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

import safe_wrappers as sw
from safe_wrappers.deprecation import deprecated_names, deprecated_parameters
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.serialize import plain_data
from safe_wrappers.wrappers.lease.stopping_budget import budget_from


@dataclass
class Wheel:
    radius: float
    width: float = 1.0


@deprecated_parameters(renamed={"colour": "paint"}, moved={"wheel": Wheel}, positional=("width",))
class Cart:
    """A cart."""

    def __init__(self, name, wheel, *, paint="red"):
        self.is_now = (name, wheel, paint)


def warned(make):
    """What is made, and the only warning."""
    with warnings.catch_warnings(record=True, action="always") as caught:
        made = make()
    (warning,) = [w for w in caught if w.category is DeprecationWarning]
    assert warning.filename == __file__
    return made, str(warning.message)


@pytest.mark.parametrize(
    ("make", "is_now", "says"),
    [
        (lambda: Cart("a", Wheel(1.0), colour="blue"), ("a", Wheel(1.0), "blue"), "Cart(..., paint=...)"),
        (
            lambda: Cart("a", 2.0, width=3.0),
            ("a", Wheel(2.0, 3.0), "red"),
            "wheel=Wheel(radius=..., width=...)",
        ),
        (lambda: Cart("a", 2.0, 3.0), ("a", Wheel(2.0, 3.0), "red"), "width is deprecated"),
        (lambda: Cart("a", radius=2.0), ("a", Wheel(2.0), "red"), "wheel=Wheel(radius=...)"),
        (
            lambda: Cart("a", colour="blue", width=2.0, radius=1.0),
            ("a", Wheel(1.0, 2.0), "blue"),
            "colour, radius, width are deprecated",
        ),
    ],
)
def test_old_parameters_work_with_one_warning(make, is_now, says):
    made, message = warned(make)
    assert made.is_now == is_now and says in message


def test_todays_parameters_give_no_warning_and_are_the_signature():
    with warnings.catch_warnings(action="error"):
        assert Cart("a", Wheel(1.0), paint="blue").is_now == ("a", Wheel(1.0), "blue")
    assert list(inspect.signature(Cart).parameters) == ["name", "wheel", "paint"]
    assert deprecated_names(Cart) == ("colour", "radius", "width") and deprecated_names(Wheel) == ()


def test_what_is_no_parameter_is_an_error_as_ever():
    for wrong in (
        lambda: Cart("a", 1.0, 2.0, 3.0),
        lambda: Cart("a", Wheel(1.0), weight=1.0),
        lambda: Cart("a"),
    ):
        with pytest.raises(TypeError):
            wrong()
    with pytest.raises(ConfigurationError, match="colour is the old name of paint"):
        Cart("a", Wheel(1.0), colour="blue", paint="red")


def rail():
    return sw.constraints.Clearance(
        [sw.constraints.Plane([-0.9], [1]), sw.constraints.Plane([0.9], [-1])], bodies=["cart"], braking=8.0
    )


@pytest.mark.parametrize(
    "old",
    [
        lambda env: sw.LeaseExpiry(env, rail(), acceleration=20.0, top_speed=3.0, margin=0.1, longest_s=0.4),
        lambda env: sw.LeaseExpiry(env, rail(), None, 20.0, None, 3.0, margin=0.1, longest_s=0.4),
        lambda env: sw.LeaseExpiry(
            env, clearance=rail(), acceleration=20.0, top_speed=3.0, margin=0.1, longest_s=0.4
        ),
    ],
)
def test_a_lease_as_it_was_written_is_the_lease_of_today(old):
    budget = sw.StoppingBudget(rail(), acceleration=20.0, top_speed=3.0, margin=0.1)
    new = sw.LeaseExpiry(gym.make("InvertedPendulum-v5"), budget, max_lease_s=0.4)
    was, message = warned(lambda: old(gym.make("InvertedPendulum-v5")))
    assert was.spec.to_json() == new.spec.to_json()
    assert "budget=StoppingBudget(clearance=..., " in message and "max_lease_s=..." in message
    data = new.spec.additional_wrappers[-1].kwargs["budget"]
    assert budget_from(data) == budget and plain_data(budget) == data


def test_a_least_lease_and_a_rate_limit_by_their_old_names():
    filtered = sw.CBFActionFilter(gym.make("InvertedPendulum-v5"), [rail()])
    budget = sw.StoppingBudget(rail(), acceleration=20.0)
    env, message = warned(lambda: sw.LeaseExpiry(filtered, budget, least_s=0.04))
    assert message == "LeaseExpiry: least_s is deprecated; write LeaseExpiry(..., min_lease_s=...)"
    assert env.spec.additional_wrappers[-1].kwargs["min_lease_s"] == 0.04
    env, message = warned(lambda: sw.ChunkHandover(gym.make("Reacher-v5"), 4, 2, jerk_limit=5.0))
    assert message == "ChunkHandover: jerk_limit is deprecated; write ChunkHandover(..., rate_limit=...)"
    assert env.spec.additional_wrappers[-1].kwargs["rate_limit"] == 5.0


def test_a_ceiling_as_it_was_written_is_the_ceiling_of_today():
    new = sw.teleop.RoundTripCeiling(
        sw.StoppingBudget(rail(), acceleration=55.0, top_speed=1.4, act_s=0.1), release=0.5
    )
    for old in (
        lambda: sw.teleop.RoundTripCeiling(rail(), None, 55.0, 1.4, act_s=0.1, release=0.5),
        lambda: sw.teleop.RoundTripCeiling(
            clearance=plain_data(rail()), acceleration=55.0, top_speed=1.4, act_s=0.1, release=0.5
        ),
    ):
        was, message = warned(old)
        assert plain_data(was) == plain_data(new) and "budget=StoppingBudget(" in message
    old = {"clearance": rail(), "acceleration": 30.0}
    with pytest.warns(DeprecationWarning, match="RoundTripCeiling"):
        sw.TeleopChannel(gym.make("InvertedPendulum-v5"), 0.1, 0.1, ceiling=old)


def test_a_spec_that_was_written_before_is_built():
    env = sw.LeaseExpiry(gym.make("InvertedPendulum-v5"), sw.StoppingBudget(rail(), acceleration=20.0))
    arguments = env.spec.additional_wrappers[-1].kwargs
    arguments |= {"clearance": plain_data(rail()), "acceleration": 20.0, "longest_s": 0.5}
    del arguments["budget"], arguments["max_lease_s"]
    with pytest.warns(DeprecationWarning, match="min_lease_s|max_lease_s"):
        again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    again.reset(seed=0)
    assert again.step(np.zeros(1, np.float32))[4]["lease/remaining_s"] > 0.0


def test_deliver_is_the_old_name_of_set_observation_time():
    env = sw.LeaseExpiry(gym.make("InvertedPendulum-v5"), sw.StoppingBudget(rail(), acceleration=20.0))
    env.reset(seed=0)
    message = warned(lambda: env.deliver(None))[1]
    assert message == "LeaseExpiry.deliver is deprecated; write set_observation_time"
    assert env.step(np.zeros(1, np.float32))[4]["lease/braking"]


def test_the_old_name_of_the_info_keys_module():
    found, says = warned(lambda: sw.interventions)
    assert found is sw.info and says.endswith("write safe_wrappers.info")
    with pytest.raises(AttributeError, match="no attribute 'intervention'"):
        sw.intervention  # noqa: B018


@pytest.mark.parametrize(
    ("make", "name", "value"),
    [
        (lambda: sw.constraints.JointPositionLimit(holds=4), "horizon", 4),
        (lambda: sw.constraints.JointSpeedLimit(5.0, reach=4.5), "max_decrease", 4.5),
        (lambda: sw.constraints.SpeedLimit(5.0, holds=2), "horizon", 2),
        (lambda: sw.constraints.Workspace(high=[1.0, 1.0, 1.0], bodies=["a"], holds=2), "horizon", 2),
        (lambda: sw.constraints.Upright("torso", tilt=0.5, holds=2), "horizon", 2),
        (
            lambda: sw.constraints.SingularityMargin(
                body="a", directions="xy", task_speed=0.1, rate_limit=5.0, holds=2
            ),
            "horizon",
            2,
        ),
        (
            lambda: sw.constraints.ImpactSpeedLimit(["a"], ["b"], force_limit=1.0, stiffness=1.0, holds=2),
            "horizon",
            2,
        ),
        (lambda: coasting(alone="robot_model"), "robot_model_attr", "robot_model"),
        (lambda: coasting(reach=0.1), "max_decrease", 0.1),
        (lambda: coasting(reach=0.1, reach_s=0.2), "max_decrease_per_speed", 0.2),
        (lambda: sw.ChunkHandover(pendulum(), 4, 2, fallback="hold", hold_s=0.05), "control_dt", 0.05),
        (lambda: leased(hold_s=0.04), "control_dt", 0.04),
        (lambda: sw.faults.Jitter(pendulum(), 0.1, hold_s=0.05), "control_dt", 0.05),
        (lambda: sw.faults.ClockSkew(pendulum(), 0.1, hold_s=0.05), "control_dt", 0.05),
        (lambda: sw.faults.DroppedRefreshes(pendulum(), 0.1, hold_s=0.05), "control_dt", 0.05),
        (lambda: sw.faults.Outages(pendulum(), 0.1, 0.2, hold_s=0.05), "control_dt", 0.05),
        (lambda: sw.AnalyticPlant(np.zeros, np.zeros, np.zeros, hold_s=0.05), "control_dt", 0.05),
    ],
)
def test_renamed_parameters_of_the_library(make, name, value):
    made, message = warned(make)
    assert getattr(made, name) == value and f"{name}=..." in message


def test_renamed_parameters_of_wrappers_over_filters():
    made, message = warned(lambda: sw.WholeBodyFilter(gym.make("Hopper-v5"), holds=3))
    assert made.spec.additional_wrappers[-1].kwargs["horizon"] == 3 and "horizon=..." in message
    teleop = gym.make("TeleopContact-v0")
    made, message = warned(lambda: sw.TeleopChannel(teleop, 0.0, 0.0, hold_s=0.001))
    assert made.control_dt == 0.001 and "control_dt=..." in message


def leased(**more):
    budget = sw.StoppingBudget(rail(), acceleration=20.0, top_speed=3.0, margin=0.1)
    return sw.LeaseExpiry(gym.make("InvertedPendulum-v5"), budget, max_lease_s=0.4, **more)


def coasting(**more):
    discs = [sw.constraints.Disc([0.0, 0.0], 1.0)]
    return sw.constraints.CoastingClearance(keep_out=discs, **more)


def pendulum():
    return gym.make("Pendulum-v1")


def test_renamed_attributes_read_and_set_the_new_ones():
    plant = sw.AnalyticPlant(np.zeros, np.zeros, np.zeros, control_dt=0.05)
    assert warned(lambda: plant.hold_s)[0] == 0.05
    warned(lambda: setattr(plant, "revision", 3))
    assert plant.model_version == 3 and warned(lambda: plant.stamp)[0] == plant.observation_id == 0
    env = sw.ChunkHandover(pendulum(), 4, 2, fallback="hold")
    assert warned(lambda: env.hold_s)[0] == env.control_dt
