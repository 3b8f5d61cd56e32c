"""Trained policies outside of training: loaded from a run's folder, or from what a run leaves for others."""

from .loading import load_policy

__all__ = ["load_policy"]
