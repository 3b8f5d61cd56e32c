"""The directive `config-keys`: a table of the keys of a config's section, from the fields of its dataclass."""

import runpy
from pathlib import Path
from typing import ClassVar

from docutils import nodes
from docutils.parsers.rst import directives
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

_KEYS = runpy.run_path(str(Path(__file__).parents[1] / "config_keys.py"))["keys"]


class ConfigKeys(SphinxDirective):
    """The dataclass's name; `prefix` is where the section stands in a config, such as `env.`."""

    required_arguments = 1
    option_spec: ClassVar = {"prefix": directives.unchanged_required}

    def run(self) -> list[nodes.Node]:
        """One row per key."""
        rows = ["| Key | Type | Default | Meaning |", "|---|---|---|---|"]
        for key in _KEYS(self.arguments[0], self.options.get("prefix", "")):
            rows.append(
                f"| `{key.name}` | {key.type} | {key.default} | {key.meaning} |"
            )
        return self.parse_text_to_nodes(StringList(rows, self.arguments[0]))


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("config-keys", ConfigKeys)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
