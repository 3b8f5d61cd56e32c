"""The symptoms, one a module: how each is measured, and which lines treat it."""
