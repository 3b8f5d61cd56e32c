"""Gymnasium wrappers, one per file, named after its class."""
