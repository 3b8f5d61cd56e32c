"""The documentation site: `make docs` builds it into build/docs, ready for file://.

A new page is a Markdown file and a line in its folder's `index.md`; a new picture is a module in `figures/` with a
function `draw`, shown by the directive `drawn`. The API is read from the modules.
"""

import contextlib
import importlib
import io
import pkgutil
import re
import sys
from pathlib import Path
from typing import Any

with contextlib.redirect_stderr(io.StringIO()):  # it greets on stderr
    import gymnasium_robotics  # noqa: F401

sys.path.insert(0, str(Path(__file__).parent / "extensions"))

project = "safe-wrappers"
author = "The safe-wrappers authors"
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "docstrings",
    "drawn",
    "mathml",
    "tables",
]
default_role = "code"  # single backticks in docstrings

myst_enable_extensions = ["dollarmath", "deflist", "colon_fence"]
myst_heading_anchors = 3

html_theme = "furo"
pygments_dark_style = "one-dark"
html_title = "safe-wrappers"
html_math_renderer = "mathml"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False
html_show_copyright = False
html_sidebars = {
    "**": [
        f"sidebar/{part}.html"
        for part in ("brand", "search", "scroll-start", "navigation", "scroll-end")
    ]
}
_LIGHT = {
    "ink": "#1d232b", "grid": "#b9bfc6", "off": "#d1601f", "on": "#1a6fb5",
    "forbidden": "#c4303e", "safe": "#2f8656", "other": "#8453ad",
}  # fmt: skip
_DARK = {
    "ink": "#dfe3e8", "grid": "#59616c", "off": "#f28e52", "on": "#62b0ef",
    "forbidden": "#ff6b76", "safe": "#6cc490", "other": "#c394e6",
}  # fmt: skip
html_theme_options = {
    "light_css_variables": {f"drawn-{name}": value for name, value in _LIGHT.items()},
    "dark_css_variables": {f"drawn-{name}": value for name, value in _DARK.items()},
}

autodoc_member_order = "bysource"
autodoc_default_options = {"exclude-members": "close, render, reset, step"}
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
add_module_names = False
python_maximum_signature_line_length = 90
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_attr_annotations = False


def _list_modules(app: Any, page: str, source: list[str]) -> None:
    """`{modules PACKAGE}`, on a line of its own, is the API of every module of the package."""

    def listed(line: re.Match[str]) -> str:
        found = pkgutil.walk_packages(
            importlib.import_module(line[1]).__path__, f"{line[1]}."
        )
        names = [module.name for module in found if not module.ispkg]
        return "\n\n".join(f".. automodule:: {name}\n   :members:" for name in names)

    source[0] = re.sub(
        r"^\{modules ([\w.]+)\}$", listed, source[0], flags=re.MULTILINE
    )


def setup(app: Any) -> None:
    """Called by Sphinx."""
    app.connect("source-read", _list_modules)
