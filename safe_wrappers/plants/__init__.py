"""What a filter may know of the machine: state, control bounds, f and g, hold interval, delay."""
