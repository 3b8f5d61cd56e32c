"""CSV files of what a page's pictures show, in a folder beside the page."""

from __future__ import annotations

import math
from pathlib import Path
from urllib.parse import quote

from ..files import write_rows
from .picture import Plotted


class PlotFiles:
    """Takes the data of the pictures as a page is put together, and writes it when the page is.

    Args:
        page: Where the page will lie; the folder `<its name without .html>_data` is made beside it.
    """

    def __init__(self, page: Path) -> None:
        self.folder = page.with_name(f"{page.stem}_data")
        self._data: dict[str, Plotted] = {}

    def link(self, data: Plotted) -> str:
        """From the page to the file that will be written, as a relative URL."""
        self._data[data.name] = data
        return quote(f"{self.folder.name}/{data.name}.csv")

    def write(self) -> None:
        """Writes a file for every picture that was linked; a number that is not finite is an empty cell."""
        if self._data:
            self.folder.mkdir(parents=True, exist_ok=True)
        for data in self._data.values():
            rows = [
                {key: value for key, value in row.items() if isinstance(value, str) or math.isfinite(value)}
                for row in data.rows
            ]
            write_rows(self.folder / f"{data.name}.csv", data.columns, rows)
