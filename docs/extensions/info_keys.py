"""The directive `info-keys`: a table of the info keys, from `safe_wrappers.info` and its docstrings."""

import importlib

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer
from sphinx.util.docutils import SphinxDirective

_MODULE = "safe_wrappers.info"


class InfoKeys(SphinxDirective):
    """Key, type and meaning: a docstring there reads "type: meaning"."""

    def run(self) -> list[nodes.Node]:
        """One row per constant that names a key and has a docstring."""
        module = importlib.import_module(_MODULE)
        rows = ["key", "type", "meaning"], *self._rows(module)
        text = [".. list-table::", "   :header-rows: 1", "   :widths: 32 18 50", ""]
        for row in rows:
            text += [
                f"   {'*' if i == 0 else ' '} - {cell}" for i, cell in enumerate(row)
            ]
        return self.parse_text_to_nodes(StringList(text, _MODULE))

    def _rows(self, module: object) -> list[list[str]]:
        documented = ModuleAnalyzer.for_module(_MODULE).find_attr_docs()
        rows = []
        for (_, name), lines in documented.items():
            text = " ".join(lines).strip()
            kind, _, meaning = text.partition(": " if ": " in text else ", ")
            value = getattr(module, name)
            keys = [value] if isinstance(value, str) else list(value)
            rows.append([" ".join(f"``{key}``" for key in keys), kind, meaning])
        return rows


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("info-keys", InfoKeys)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
