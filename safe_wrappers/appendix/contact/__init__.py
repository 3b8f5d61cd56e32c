"""Contact: impacts, forces of simple shapes, contact steps as linear complementarity problems."""
