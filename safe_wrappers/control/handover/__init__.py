"""Blends from one command sequence to the next, and the seams between them."""
