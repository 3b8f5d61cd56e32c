"""Whether frames can be drawn is asked in another process: nothing that it does may reach this one."""

import pytest

from safe_wrappers.train.config import EnvConfig
from safe_wrappers.train.videos import rendering
from safe_wrappers.train.videos.rendering import Rendering, find_rendering


def filmed(trouble=""):
    return EnvConfig("fake_task:FilmedGoal-v0", {"trouble": trouble})


def test_a_task_that_draws_without_gl_needs_nothing(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disabled")
    assert find_rendering(filmed()) == Rendering({"MUJOCO_GL": "disabled"})


@pytest.mark.parametrize(
    ("trouble", "reason"),
    [("raise", "RuntimeError: no display"), ("abort", "the process ended with status -6")],
)
def test_what_goes_wrong_is_one_line(monkeypatch, trouble, reason):
    monkeypatch.setenv("MUJOCO_GL", "disabled")
    found = find_rendering(filmed(trouble))
    assert found.variables == {}
    assert f"could not draw a frame here (MUJOCO_GL=disabled: {reason})." in found.problem
    assert "apt install libosmesa6" in found.problem
    assert "\n" not in found.problem


def test_a_library_that_never_comes_back_is_left(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disabled")
    monkeypatch.setattr(rendering, "_SECONDS", 2.0)
    assert "no frame within 2 s" in find_rendering(filmed("hang")).problem


def test_a_mujoco_task_with_gl_switched_off_says_so(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disabled")
    assert find_rendering(EnvConfig("Reacher-v5")).problem.startswith(
        "Reacher-v5 could not draw a frame here (MUJOCO_GL=disabled: "
    )


def test_a_mujoco_task_is_drawn_or_the_reason_is_said(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    found = find_rendering(EnvConfig("Reacher-v5"))
    assert found.problem == "" or "Reacher-v5 could not draw a frame here (" in found.problem


def test_without_a_choice_linux_tries_egl_and_then_osmesa(monkeypatch):
    tried = []
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(rendering.sys, "platform", "linux")
    monkeypatch.setattr(rendering, "_probe", lambda env, variables: tried.append(variables) or "no")
    problem = find_rendering(filmed()).problem
    assert tried == [{"MUJOCO_GL": "egl"}, {"MUJOCO_GL": "osmesa"}]
    assert "(MUJOCO_GL=egl: no; MUJOCO_GL=osmesa: no)" in problem
    monkeypatch.setattr(
        rendering, "_probe", lambda env, variables: "" if "osmesa" in str(variables) else "no"
    )
    assert find_rendering(filmed()) == Rendering({"MUJOCO_GL": "osmesa"})
