"""What pyproject.toml cannot say: that two of the packages lie elsewhere, and where README.md's links lead to."""

import re
import tomllib
from pathlib import Path

from setuptools import find_packages, setup

HERE = Path(__file__).parent
INSIDE = ("envs", "train")
"""They sit at the top of the repo, but install inside the package: no stray top-level names."""


def for_a_package_page(readme: str, home: str) -> str:
    """README.md with absolute links: a page of a package index has no files beside it."""
    relative = r"\]\((?!https?://|#)"
    readme = re.sub(rf"(!\[[^\]]*){relative}", rf"\1]({home}/raw/main/", readme)
    return re.sub(relative, f"]({home}/blob/main/", readme)


project = tomllib.loads((HERE / "pyproject.toml").read_text(encoding="utf-8"))["project"]
setup(
    packages=[
        *find_packages(include=["safe_wrappers", "safe_wrappers.*"]),
        *(f"safe_wrappers.{name}" for top in INSIDE for name in find_packages(include=[top, f"{top}.*"])),
    ],
    package_dir={f"safe_wrappers.{top}": top for top in INSIDE},
    long_description=for_a_package_page(
        (HERE / "README.md").read_text(encoding="utf-8"), project["urls"]["Repository"]
    ),
    long_description_content_type="text/markdown",
)
