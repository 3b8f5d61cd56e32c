"""`safe-wrappers diagnose`: symptoms of an env and of a trained policy, as a table, a page and JSON."""

from .command import diagnose_command

__all__ = ["diagnose_command"]
