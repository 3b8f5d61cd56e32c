"""Parts of TeleopChannel."""
