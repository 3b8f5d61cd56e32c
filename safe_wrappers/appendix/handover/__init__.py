"""Trajectories: splines, blends, polynomial extrema, flexible joints."""
