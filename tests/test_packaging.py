"""The wheel, which works without torch and Stable-Baselines3, and the lock, which says what constraints.txt says."""

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

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
HOME = PROJECT["urls"]["Repository"]

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
    for entry in Path(sysconfig.get_paths()["purelib"]).iterdir():
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


def test_the_wheel_has_every_module_and_asset_of_the_repository_and_nothing_else(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    wanted = set()
    for folder, inside in (("safe_wrappers", ""), ("envs", "envs/"), ("train", "train/")):
        for path in (ROOT / folder).rglob("*"):
            if path.suffix in (".py", ".xml", ".html") or path.name == "py.typed":
                wanted.add(f"safe_wrappers/{inside}{path.relative_to(ROOT / folder).as_posix()}")
    assert {name for name in names if ".dist-info/" not in name} == wanted
    assert sum(name.startswith("safe_wrappers/envs/assets/") for name in wanted) >= 5


def metadata_of(wheel):
    archive = zipfile.ZipFile(wheel)
    (name,) = [n for n in archive.namelist() if n.endswith(".dist-info/METADATA")]
    return email.message_from_string(archive.read(name).decode())


def test_it_works_without_torch_and_stable_baselines_and_says_what_needs_them(python, tmp_path):
    code = """
import sys
import gymnasium as gym
gym.make("safe_wrappers:SafePointGoal1-v0")  # its tasks are made without an import
import safe_wrappers as sw
assert "site-packages" in sw.__file__, sw.__file__
for name in ("torch", "stable_baselines3", "tensorboard", "matplotlib", "scipy.linalg", "qpsolvers", "envs", "train"):
    assert name not in sys.modules, name
missing = [n for n in sw.__all__ if not hasattr(sw, n)]
assert not missing, missing
safe = sw.protect(gym.make("SafePointGoal2-v0"))
safe.reset(seed=0)
assert "cbf/margin" in safe.step(safe.action_space.sample())[4]
try:
    import safe_wrappers.sb3
except ImportError as error:
    print(error)
"""
    done = run(python, code, tmp_path)
    assert done.returncode == 0, done.stderr
    assert "stable_baselines3" in done.stdout or "train" in done.stdout


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


PIN = re.compile(r"^([\w.-]+)==([^\s;\\]+)", re.MULTILINE)


def pins(text):
    return {re.sub(r"[-_.]+", "-", name).lower(): version for name, version in PIN.findall(text)}


def test_the_lock_has_the_versions_of_constraints_with_hashes_and_no_address():
    lock = (ROOT / "requirements.lock").read_text()
    known, locked = pins((ROOT / "constraints.txt").read_text()), pins(lock)
    assert {"numpy", "torch", "mujoco", "pytest", "ruff", "sb3-contrib"} <= locked.keys()
    assert {name: known[name] for name in locked.keys() & known.keys()} == {
        name: version for name, version in locked.items() if name in known
    }
    of_cuda = {name for name in locked.keys() - known.keys() if name.startswith(("nvidia-", "cuda-"))}
    others = {"triton", "setuptools", "colorama"}  # and other systems' own
    assert locked.keys() - known.keys() - of_cuda <= others
    entries = re.split(r"^(?=[\w.-]+==)", lock, flags=re.MULTILINE)[1:]
    assert len(entries) == len(PIN.findall(lock))
    assert all(re.search(r"--hash=sha256:[0-9a-f]{64}", entry) for entry in entries)
    assert "://" not in lock
