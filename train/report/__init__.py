"""The HTML page of an experiment, its table on the terminal, and the verdict in words."""

from .page import write_report
from .tables import comparison_table, verdict

__all__ = ["comparison_table", "verdict", "write_report"]
