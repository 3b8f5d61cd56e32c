"""Centroidal momentum, zero moment point, moving bodies of a model."""
