"""Runs in parallel processes: started, watched, stopped, and shown on the terminal."""
