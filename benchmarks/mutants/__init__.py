"""Mutants: small mistakes in the code that the tests around it have to find; `python -m benchmarks.mutants`."""
