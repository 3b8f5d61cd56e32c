"""Wheels: slip, traction curves, friction estimate."""
