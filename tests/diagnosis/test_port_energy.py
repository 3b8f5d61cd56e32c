"""Energy at a port: against integrals by hand, the channel's own account, and links whose delay is known."""

import gymnasium as gym
import numpy as np
import pytest

import safe_wrappers as sw
from safe_wrappers.diagnosis import diagnose
from safe_wrappers.diagnosis.recording import record
from safe_wrappers.diagnosis.symptom import NotMeasuredError
from safe_wrappers.diagnosis.symptoms import port_energy

pytest.importorskip("gymnasium_robotics")
from planted import LateBothWays, Operating

pytestmark = pytest.mark.filterwarnings("ignore")


class Port(gym.Env):
    """Nothing but a port: action 0 is its flow, entry 1 of the observation its effort."""

    action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float64)
    observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float64)
    port_flow, port_effort_observed, port_feedthrough = (0,), (1,), 0.0


class Seen:
    """Six control steps of 0.1 s, of two episodes."""

    control_dt = 0.1
    first = np.array([True, False, False, True, False, False])
    actions = np.array([[0.5, 9.0], [0.5, 9.0], [3.0, 9.0], [0.5, 9.0], [0.5, 9.0], [0.0, 9.0]])
    executed = np.array([[0.5, 0.0], [0.5, 0.0], [-0.5, 0.0], [0.5, 0.0], [0.5, 0.0], [0.5, 0.0]])
    efforts = np.array([2.0, 2.0, 2.0, -4.0, -4.0, 8.0])
    port_efforts = np.array([[1.0], [1.0], [4.0], [0.0], [2.0], [6.0]])
    contacts = ({(1, 2)}, {(1, 2), (3, 4)}, set(), {(1, 2)}, set(), {(1, 2)})
    revoked = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0])

    @property
    def shown(self):
        return [np.array([7.0, effort, 7.0]) for effort in self.efforts]

    def of_info(self, key):
        return self.revoked if key == "teleop/revoked" else np.full(6, np.nan)


def test_energy_is_the_integral_by_hand():
    measured = port_energy.measure(Port(), Seen())
    # In less out, W: 1 - 0.5, 1 - 0.5, 2 (the action is clipped to 1) + 2; then -2, -2 (revoked: 0 out), 0 - 3.
    assert measured.steps == pytest.approx([0.0, 0.0, 0.0, 0.2, 0.4, 0.7])
    assert measured.figure == pytest.approx(0.7)
    found = {each.name: each.value for each in measured.evidence}
    assert found["largest force that acted"] == 6.0
    assert found["work of the operator, either way"] == pytest.approx(0.1 * (1 + 1 + 2 + 2 + 2 + 0))
    assert found["contacts that begin"] == pytest.approx(2 / 0.6)  # what touches after a reset has not begun


def test_efforts_that_are_not_published_are_foreseen():
    class Silent(Seen):
        port_efforts = np.zeros(0)
        answered = tuple(np.array([0.0, effort, 0.0]) for effort in (1.0, 2.0, 3.0, 4.0, 5.0, 6.0))

    damped = sw.teleop.TeleopPort([0], [1], feedthrough=10.0)
    flow = np.array([[0.0], [0.5], [0.5], [0.2], [0.2], [0.2]])
    found = port_energy._acted(Silent(), damped, flow)[:, 0]
    assert found == pytest.approx([1.0, 1.0 + 5.0, 2.0, 3.0 - 3.0, 4.0, 5.0])


@pytest.mark.parametrize(("coding", "made"), [("plain", True), ("wave", False)])
def test_the_channel_says_the_same(coding, made):
    given = {"coding": "wave", "impedance": 40.0} if coding == "wave" else {}
    env = sw.TeleopChannel(gym.make("TeleopContact-v0"), 0.1, 0.1, **given)
    recording = record(env, Operating(), 2600, 0)
    figure = port_energy.measure(env, recording).figure
    told = recording.infos[-1]["teleop/created_j"]
    assert figure == pytest.approx(told, abs=1e-6)
    assert (figure > 1.0) == made


def test_a_link_of_ones_own_is_replaced_with_its_delays():
    env = LateBothWays(gym.make("TeleopContact-v0"), 60)
    finding = diagnose(env, Operating(), steps=3000, symptoms=["port_energy"]).findings[0]
    assert finding.present and "env.env, 0.06, 0.06" in finding.code and "LateBothWays" in finding.advice
    assert finding.after <= 0.5 * finding.figure


def test_without_a_link_nothing_is_made_and_without_a_port_nothing_is_said():
    bare = gym.make("TeleopContact-v0")
    assert port_energy.measure(bare, record(bare, Operating(), 2500, 0)).figure < 0.01
    swimmer = gym.make("Swimmer-v5")
    told = diagnose(swimmer, lambda seen: np.zeros(2, np.float32), steps=10, symptoms=["port_energy"])
    assert "publishes no port" in told.findings[0].missing
    images = Port()
    images.observation_space = gym.spaces.Box(0, 255, (3, 3), np.uint8)
    with pytest.raises(NotMeasuredError, match="one axis"):
        port_energy.measure(images, Seen())


def test_where_no_line_can_be_run_it_is_told():
    ceiling = sw.teleop.RoundTripCeiling(
        sw.StoppingBudget(lambda env: ([9.0], [0.0]), braking=24.0, acceleration=55.0, top_speed=1.4)
    )
    watched = sw.TeleopChannel(gym.make("TeleopContact-v0"), 0.0, 0.0, ceiling=ceiling)
    code, advice = port_energy.lines(watched, record(watched, Operating(), 5, 0))
    assert not code and "impedance=40" in advice and "beside the ceiling" in advice
    outer = sw.RecordInterventions(sw.TeleopChannel(gym.make("TeleopContact-v0"), 0.1, 0.1))
    code, advice = port_energy.lines(outer, record(outer, Operating(), 5, 0))
    assert not code and "both ends" in advice
    still = LateBothWays(gym.make("TeleopContact-v0"), 3)
    code, advice = port_energy.lines(still, record(still, lambda seen: np.random.rand(2), 40, 0))
    assert "0.003, 0.003" in code
    lossy = sw.TeleopChannel(gym.make("TeleopContact-v0"), sw.teleop.Link(0.1, loss=0.02), 0.0)
    code, _ = port_energy.lines(lossy, record(lossy, Operating(), 5, 0))
    assert "sw.teleop.Link(delay_s=0.1, loss=0.02), 0, coding" in code


def test_a_driver_with_a_reset_is_told_of_episodes():
    class Counts:
        resets = 0

        def reset(self):
            self.resets += 1

        def __call__(self, observation):
            return np.zeros(2, np.float32)

    driver = Counts()
    record(gym.make("Reacher-v5"), driver, 120, 0)
    assert driver.resets == 3 + 1  # once more after it was asked whether it repeats itself
