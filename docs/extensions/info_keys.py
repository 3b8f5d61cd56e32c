"""The directives `info-keys` and `episode-figures`: tables of the registry in `safe_wrappers.info`."""

from abc import ABC, abstractmethod

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer
from sphinx.util.docutils import SphinxDirective

from safe_wrappers import info

_MODULE = "safe_wrappers.info"


class _Table(SphinxDirective, ABC):
    """A table from rows of cells, the first row its head."""

    widths: str

    @abstractmethod
    def rows(self) -> list[list[str]]:
        """The cells, reStructuredText."""

    def run(self) -> list[nodes.Node]:
        """The table."""
        text = [
            ".. list-table::",
            "   :header-rows: 1",
            f"   :widths: {self.widths}",
            "",
        ]
        for row in self.rows():
            text += [
                f"   {'*' if i == 0 else ' '} - {cell}" for i, cell in enumerate(row)
            ]
        return self.parse_text_to_nodes(StringList(text, _MODULE))


class InfoKeys(_Table):
    """One row per constant that names keys; its docstring is the meaning."""

    widths = "30 14 8 16 32"

    def rows(self) -> list[list[str]]:
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
        return rows


class EpisodeFigures(_Table):
    """One row per figure of an episode."""

    widths = "30 15 55"

    def rows(self) -> list[list[str]]:
        """Figure, and how it is made from which keys."""
        rows = [["figure", "how", "of"]]
        for figure in info.EPISODE:
            of = ", ".join(f"``{name}``" for name in figure.of)
            rows.append([f"``{figure.name}``", figure.how, of])
        return rows


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directives."""
    app.add_directive("info-keys", InfoKeys)
    app.add_directive("episode-figures", EpisodeFigures)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
