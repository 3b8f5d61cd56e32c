"""What constraints and wrappers ask of a model beyond its linear form."""
