"""Reachability, and the delays of a lease."""
