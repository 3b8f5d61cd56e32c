"""Constraints on contacts: impact speed, friction cones, support."""
