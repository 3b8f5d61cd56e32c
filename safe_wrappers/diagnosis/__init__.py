"""From symptom to tool: what is wrong with an env and a policy, and which wrapper treats it."""

from safe_wrappers.diagnosis.finding import Diagnosis, Evidence, Finding
from safe_wrappers.diagnosis.run import SYMPTOMS, diagnose

__all__ = ["SYMPTOMS", "Diagnosis", "Evidence", "Finding", "diagnose"]
