"""Shapes to keep clear of, at rest, moving, or tracked with uncertainty."""
