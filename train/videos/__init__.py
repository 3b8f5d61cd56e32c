"""The same episode on film, in every arm and condition."""
