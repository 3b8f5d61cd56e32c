"""Draws one picture, or all of them: `python docs/figures/draw.py [FOLDER [NAME ...]]`.

Each picture is a module beside this one with a function `draw` that returns a matplotlib figure, made by running the
library; a module whose name begins with an underscore is a helper. The same code draws the same bytes.
"""

import importlib
import sys
from pathlib import Path
from unittest import mock

_HERE = Path(__file__).parent


def names() -> list[str]:
    """Every picture, by its module's name."""
    return sorted(p.stem for p in _HERE.glob("*.py") if not p.stem.startswith("_") and p.stem != "draw")


def svg(name: str) -> str:
    """One picture as SVG text, its colours left to the page."""
    # Pictures import their helpers by plain names, as scripts do; nobody else's imports change.
    with mock.patch.object(sys, "path", [str(_HERE), *sys.path]):
        style = importlib.import_module("_style")
        picture = importlib.import_module(name)
        return str(style.as_svg(picture.draw, name))


if __name__ == "__main__":
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
    folder.mkdir(parents=True, exist_ok=True)
    for wanted in sys.argv[2:] or names():
        (folder / f"{wanted}.svg").write_text(svg(wanted))
