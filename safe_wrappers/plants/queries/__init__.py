"""What constraints and wrappers need of a model beyond its linear form."""
