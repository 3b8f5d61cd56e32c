"""Parts of the goal tasks: robots, levels, layouts, what the lidar sees."""
