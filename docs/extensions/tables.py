"""Directives for tables of what the code says of itself: `config-keys`, `info-keys` and `episode-figures`."""

import runpy
from pathlib import Path
from typing import ClassVar

from docutils import nodes
from docutils.parsers.rst import directives
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer
from sphinx.util.docutils import SphinxDirective

from safe_wrappers import info

_KEYS = runpy.run_path(str(Path(__file__).parents[1] / "config_keys.py"))["keys"]
_MODULE = "safe_wrappers.info"


class ConfigKeys(SphinxDirective):
    """The keys of a config's section, from the fields of its dataclass, whose name is the argument.

    `prefix` is where the section stands in a config, such as `env.`.
    """

    required_arguments = 1
    option_spec: ClassVar = {"prefix": directives.unchanged_required}

    def run(self) -> list[nodes.Node]:
        """One row per key."""
        rows = ["| Key | Type | Default | Meaning |", "|---|---|---|---|"]
        for key in _KEYS(self.arguments[0], self.options.get("prefix", "")):
            rows.append(f"| `{key.name}` | {key.type} | {key.default} | {key.meaning} |")
        return self.parse_text_to_nodes(StringList(rows, self.arguments[0]))


class _InfoTable(SphinxDirective):
    def _table(self, widths: str, rows: list[list[str]]) -> list[nodes.Node]:
        """A table of cells in reStructuredText, the first row its head."""
        text = [".. list-table::", "   :header-rows: 1", f"   :widths: {widths}", ""]
        for row in rows:
            text += [f"   {'*' if i == 0 else ' '} - {cell}" for i, cell in enumerate(row)]
        return self.parse_text_to_nodes(StringList(text, _MODULE))


class InfoKeys(_InfoTable):
    """One row per constant of `safe_wrappers.info` that names keys; its docstring is the meaning."""

    def run(self) -> list[nodes.Node]:
        """Key, type and unit, what it becomes in a chunk, its name in the logger, meaning."""
        rows = [["key", "type, unit", "in a chunk", "logged as", "meaning"]]
        documented = ModuleAnalyzer.for_module(_MODULE).find_attr_docs()
        for (_, constant), lines in documented.items():
            value = getattr(info, constant, None)
            names = [value] if isinstance(value, str) else value
            if isinstance(names, list | tuple) and set(names) <= set(info.KEYS):
                key = info.KEYS[names[0]]
                kind = f"{key.dtype} {key.shape}".rstrip()
                rows.append(
                    [
                        " ".join(f"``{name}``" for name in names),
                        f"{kind}, {key.unit}" if key.unit else kind,
                        key.chunk,
                        f"``step_{key.log}``" if key.log else "",
                        " ".join(lines).strip(),
                    ]
                )
        return self._table("30 14 8 16 32", rows)


class EpisodeFigures(_InfoTable):
    """One row per figure of an episode."""

    def run(self) -> list[nodes.Node]:
        """Figure, and how it is made from which keys."""
        rows = [["figure", "how", "of"]]
        for figure in info.EPISODE:
            of = ", ".join(f"``{name}``" for name in figure.of)
            rows.append([f"``{figure.name}``", figure.how, of])
        return self._table("30 15 55", rows)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directives."""
    app.add_directive("config-keys", ConfigKeys)
    app.add_directive("info-keys", InfoKeys)
    app.add_directive("episode-figures", EpisodeFigures)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
