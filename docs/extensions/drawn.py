"""The directive `drawn`: a picture of `figures/`, drawn when the site is built, as SVG inside the page.

An `<img>` cannot follow the page between light and dark; an inline picture takes the page's colours and font.
"""

import html
import runpy
from pathlib import Path
from typing import ClassVar

from docutils import nodes
from docutils.parsers.rst import directives
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

_FIGURES = Path(__file__).parents[1] / "figures"


class Drawn(SphinxDirective):
    """The picture's name; `alt` says what it shows to those who cannot see it; the content is the caption."""

    required_arguments = 1
    option_spec: ClassVar = {"alt": directives.unchanged_required}
    has_content = True

    def run(self) -> list[nodes.Node]:
        """Draw, and set between the tags of a figure."""
        name = self.arguments[0]
        names = runpy.run_path(str(_FIGURES / "draw.py"))
        if name not in names["names"]():
            raise self.error(f"no picture {name!r}; there are {', '.join(names['names']())}")
        if not self.options.get("alt"):
            raise self.error(f"picture {name!r} needs :alt:")
        alt = html.escape(" ".join(self.options["alt"].split()))
        picture = names["svg"](name).replace("<svg ", f'<svg role="img" aria-label="{alt}" ', 1)
        caption = self.parse_content_to_nodes()
        return [
            nodes.raw("", f'<figure class="drawn">{picture}<figcaption>', format="html"),
            *caption,
            nodes.raw("", "</figcaption></figure>", format="html"),
        ]


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("drawn", Drawn)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
