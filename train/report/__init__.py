"""The HTML pages: one per experiment, and one that puts several side by side; and the verdict in words."""

from .experiment_page import write_report
from .overview_page import write_overview
from .verdict import verdict

__all__ = ["verdict", "write_overview", "write_report"]
