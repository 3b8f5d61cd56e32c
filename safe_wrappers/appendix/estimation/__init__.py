"""Estimation: covariance, filter consistency, observability, tail probabilities, lever arms."""
