"""Parts of the rover's task."""
