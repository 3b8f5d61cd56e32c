"""An env's own simulation as the filter's model: copies, restored states, forks."""
