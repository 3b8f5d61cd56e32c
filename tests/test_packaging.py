"""The wheel: what is in it, and that it works in an environment that has neither torch nor Stable-Baselines3."""

import email
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
HOME = PROJECT["urls"]["Repository"]
SITE = sysconfig.get_paths()["purelib"]

BLOCK = '''
import sys

class Absent:
    """Torch, Stable-Baselines3 and the repository itself are not installed here."""

    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("torch", "stable_baselines3", "tensorboard"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Absent())
'''


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel, built from a copy so that nothing is left in the checkout."""
    source = tmp_path_factory.mktemp("source")
    for name in ("safe_wrappers", "envs", "train", "pyproject.toml", "setup.py", "LICENSE", "README.md"):
        origin = ROOT / name
        if origin.is_dir():
            shutil.copytree(origin, source / name, ignore=shutil.ignore_patterns("__pycache__"))
        elif origin.exists():
            shutil.copy(origin, source / name)
    target = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    command += ["--disable-pip-version-check", "--no-index", "--wheel-dir", str(target), str(source)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (built,) = target.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def python(wheel, tmp_path_factory):
    """An interpreter with the wheel unpacked, the libraries it depends on, and nothing else of ours."""
    folder = tmp_path_factory.mktemp("venv")
    venv.create(folder, with_pip=False, symlinks=True)
    site = next((folder / "lib").glob("python*")) / "site-packages"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    # The dependencies are linked one by one: without .pth files, so no editable install of ours comes along.
    hidden = ("safe_wrappers", "__editable__", "torch", "stable_baselines3", "tensorboard")
    for entry in Path(SITE).iterdir():
        if not entry.name.startswith(hidden) and entry.suffix != ".pth" and not (site / entry.name).exists():
            (site / entry.name).symlink_to(entry)
    (site / "sitecustomize.py").unlink(missing_ok=True)
    (site / "sitecustomize.py").write_text(BLOCK)
    return folder / "bin" / "python"


def run(python, code, folder):
    environ = {"PATH": os.environ.get("PATH", ""), "MUJOCO_GL": "disabled", "OMP_NUM_THREADS": "1"}
    environ["SAFE_WRAPPERS_COMPILED"] = "0"  # the same bits, without compiling for this copy
    return subprocess.run(
        [str(python), "-c", code], cwd=folder, env=environ, capture_output=True, text=True, check=False
    )


def test_nothing_stray_in_the_wheel(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    tops = {n.split("/")[0] for n in names}
    assert {t for t in tops if not t.endswith(".dist-info")} == {"safe_wrappers"}
    for part in ("control", "plants", "constraints", "wrappers", "sb3", "envs", "train"):
        assert f"safe_wrappers/{part}/__init__.py" in names
    assert not any("test" in n.split("/")[-1] or "__pycache__" in n for n in names)


def test_the_wheel_has_every_module_and_asset_of_the_repository(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    for folder, inside in (
        ("safe_wrappers", "safe_wrappers"),
        ("envs", "safe_wrappers/envs"),
        ("train", "safe_wrappers/train"),
    ):
        for path in (ROOT / folder).rglob("*"):
            if path.suffix in (".py", ".xml", ".html") or path.name == "py.typed":
                assert f"{inside}/{path.relative_to(ROOT / folder).as_posix()}" in names, path
    assert sum(n.startswith("safe_wrappers/envs/assets/") and n.endswith(".xml") for n in names) >= 5


def metadata_of(wheel):
    archive = zipfile.ZipFile(wheel)
    (name,) = [n for n in archive.namelist() if n.endswith(".dist-info/METADATA")]
    return email.message_from_string(archive.read(name).decode())


def test_metadata(wheel):
    archive, metadata = zipfile.ZipFile(wheel), metadata_of(wheel)
    assert metadata["Name"] == "safe-wrappers"
    assert metadata["Requires-Python"] == ">=3.11"
    assert metadata["License-Expression"] == "MIT"
    plain = [r for r in metadata.get_all("Requires-Dist") if "extra ==" not in r]
    needed = {re.split(r"[\s<>=\[;!~]", r)[0].lower() for r in plain}
    assert needed == {
        "numpy",
        "scipy",
        "gymnasium",
        "mujoco",
        "numba",
        "pillow",
        "daqp",
        "clarabel",
        "ruckig",
    }
    mujoco = [Requirement(r) for r in metadata.get_all("Requires-Dist") if r.startswith("mujoco")]
    for version, extra, taken in (
        ("3.4.0", "", False), ("3.5.0", "", True), ("4.0.0", "", True), ("5.0.0", "", False),
        ("3.11.0", "robotics", True), ("3.12.0", "robotics", False),
    ):  # fmt: skip
        asked = [r for r in mujoco if r.marker is None or r.marker.evaluate({"extra": extra})]
        assert all(r.specifier.contains(version) for r in asked) == taken, (version, extra)
    (scripts,) = [n for n in archive.namelist() if n.endswith("entry_points.txt")]
    assert "safe-wrappers = safe_wrappers.train.cli:main" in archive.read(scripts).decode()


def test_it_imports_without_torch_and_stable_baselines(python, tmp_path):
    code = """
import sys
import safe_wrappers as sw
assert "site-packages" in sw.__file__, sw.__file__
for name in ("torch", "stable_baselines3", "tensorboard", "matplotlib", "scipy.linalg", "qpsolvers", "envs", "train"):
    assert name not in sys.modules, name
missing = [n for n in sw.__all__ if not hasattr(sw, n)]
assert not missing, missing
try:
    import torch
except ModuleNotFoundError:
    print("absent")
"""
    done = run(python, code, tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "absent"


def test_its_tasks_are_made_without_an_import(python, tmp_path):
    code = """
import gymnasium as gym
env = gym.make("safe_wrappers:SafePointGoal1-v0")
env.reset(seed=0)
env.step(env.action_space.sample())
import safe_wrappers as sw
safe = sw.protect(gym.make("SafePointGoal2-v0"))
safe.reset(seed=0)
assert "cbf/margin" in safe.step(safe.action_space.sample())[4]
print("ok")
"""
    done = run(python, code, tmp_path)
    assert done.stdout.strip() == "ok", done.stderr


def test_the_blocks_of_the_package_page_run(wheel, python, tmp_path):
    blocks = re.findall(r"^```python\n(.*?)^```", metadata_of(wheel).get_payload(), re.DOTALL | re.MULTILINE)
    assert len(blocks) >= 3
    steps = "env.reset(seed=0)\nfor _ in range(3):\n    info = env.step(env.action_space.sample())[4]\n"
    done = run(
        python, "".join(f"{block}\n{steps}print('cbf/margin' in info)\n" for block in blocks), tmp_path
    )
    assert done.stdout.split() == ["True"] * len(blocks), done.stderr


def test_addresses_and_versions_agree():
    yaml = pytest.importorskip("yaml")  # of the training scripts
    assert all(url.startswith(HOME) for url in PROJECT["urls"].values())
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert (cited["repository-code"], cited["version"]) == (HOME, PROJECT["version"])
    assert f"## {PROJECT['version']}" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    checks = yaml.safe_load((ROOT / ".github/workflows/checks.yml").read_text(encoding="utf-8"))
    pythons = checks["jobs"]["library"]["strategy"]["matrix"]["python"]
    assert [f"Programming Language :: Python :: {one}" for one in pythons] == [
        one for one in PROJECT["classifiers"] if " :: 3." in one
    ]


def test_what_needs_stable_baselines_says_so(python, tmp_path):
    done = run(python, "import safe_wrappers.sb3", tmp_path)
    assert done.returncode != 0
    assert "stable_baselines3" in done.stderr or "train" in done.stderr
