"""The filter engine without Gymnasium: constraints, one projection, the search for an admissible action."""
