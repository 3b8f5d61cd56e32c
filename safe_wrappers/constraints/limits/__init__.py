"""Limits on joints, speeds, tilt and workspace, judged on a rollout of the model."""
