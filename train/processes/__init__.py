"""Runs in parallel processes: started, watched, stopped, and shown on the terminal."""

from .job import Interrupted, Job, Progress, RunsFailedError, RunStoppedError, environment
from .parallel import run_jobs

__all__ = [
    "Interrupted",
    "Job",
    "Progress",
    "RunStoppedError",
    "RunsFailedError",
    "environment",
    "run_jobs",
]
