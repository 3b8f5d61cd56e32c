"""The HTML pages: one per experiment, and one that puts several side by side."""

from .experiment_page import write_report
from .overview_page import write_overview

__all__ = ["write_overview", "write_report"]
