"""Stopping distances and evasive manoeuvres in closed form."""
