"""Wrappers for who learns through a filter: what the learner sees, is paid for, and how its actions get through."""
