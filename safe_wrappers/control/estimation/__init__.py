"""Covariance without measurements, Kalman filter, tracks, observability."""
