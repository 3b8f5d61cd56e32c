"""Models that nobody thought of: supported or refused by name. More by `python -m benchmarks.random_models`."""

import pytest
from hypothesis import HealthCheck, Phase, example, given, settings
from hypothesis import strategies as st

import safe_wrappers as sw
from benchmarks import random_models
from benchmarks.random_mjcf import RandomModel
from benchmarks.random_models import kind_of, outcomes, run, trial

FIRST = 7  # seed of a model that is supported


@pytest.fixture(autouse=True)
def log_elsewhere(tmp_path, monkeypatch):
    """MuJoCo writes its log into the working directory."""
    monkeypatch.chdir(tmp_path)


@settings(
    max_examples=50 if settings.default.derandomize else 2000,
    phases=[Phase.explicit, Phase.reuse, Phase.generate],  # a seed has no simpler one
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@pytest.mark.filterwarnings("ignore::UserWarning")
@given(seed=st.integers(0, 2**32))
@example(seed=6)  # infinite controls that a forcerange clamps
@example(seed=105)  # a probe of actions that diverges
@example(seed=284)  # actuation is disabled
@example(seed=883)  # no joints
@example(seed=1413)  # a projection beyond float32
def test_a_model_is_supported_or_refused_by_name(seed):
    outcome, why = trial(seed)
    assert outcome != "defect", why


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_wrong_forecast_is_a_defect(monkeypatch):
    assert trial(FIRST)[0] == "supported"
    forecast = sw.MujocoPlant.forecast
    monkeypatch.setattr(sw.MujocoPlant, "forecast", lambda plant, u, *more: forecast(plant, u + 0.01, *more))
    assert trial(FIRST)[0] == "defect"


def test_a_seed_is_always_the_same_model():
    assert RandomModel(7).xml == RandomModel(7).xml != RandomModel(8).xml


STUB = """#!/bin/sh
if [ "$4" = 0 ]; then echo 0; echo '["supported", ""]'; echo 1; echo simulated; kill -SEGV $$; fi
if [ "$4" = 3 ]; then echo 3; kill -SEGV $$; fi
echo "$4"; echo '["refused", "actuator '"'hip3'"' has a delay of 0.02 s. Use AnalyticPlant"]'
"""


def test_a_crash_has_a_seed_and_ends_nothing(tmp_path, monkeypatch):
    stub = tmp_path / "python"
    stub.write_text(STUB)
    stub.chmod(0o755)
    monkeypatch.setattr(random_models.sys, "executable", str(stub))
    (first, crash, last) = outcomes(0, 3)
    assert first == (0, "supported", "")
    assert crash == (1, "defect", f"the interpreter ended with {-11}")
    assert last[:2] == (2, "refused") and kind_of(last[2]) == "actuator '...' has a delay of N s."
    assert list(outcomes(3, 4)) == [(3, "mujoco", f"the interpreter ended with {-11}")]  # without the library
    monkeypatch.setattr(random_models, "BATCH", 3)
    run(3, tmp_path)
    assert "| defect | 1 |" in (tmp_path / "random_models.md").read_text()
    run(3, tmp_path)  # the defect is tried again
    assert "| defect | 0 |" in (tmp_path / "random_models.md").read_text()


def test_a_hang_is_a_defect(tmp_path, monkeypatch):
    stub = tmp_path / "python"
    stub.write_text("#!/bin/sh\necho 0\nexec sleep 60\n")
    stub.chmod(0o755)
    monkeypatch.setattr(random_models.sys, "executable", str(stub))
    monkeypatch.setattr(random_models, "LONGEST_S", 0.2)
    assert list(outcomes(0, 1)) == [(0, "defect", "more than 0.2 s")]
