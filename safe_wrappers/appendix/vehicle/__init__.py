"""Wheel slip and Burckhardt's traction curve."""
