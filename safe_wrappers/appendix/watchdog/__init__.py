"""Reachability, and the phase that sampling and delay cost."""
