"""Barriers in continuous time, and least-norm joint rates."""
