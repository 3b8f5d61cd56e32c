"""Measurements that the README and docs/results quote; each module runs by itself: `python -m benchmarks.<name>`."""
