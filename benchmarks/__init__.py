"""Measurements that the README and docs/results quote; those with a `main` run by name."""
