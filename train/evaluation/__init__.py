"""Paired evaluation of the trained policies, what it records, and the numbers it comes to."""
