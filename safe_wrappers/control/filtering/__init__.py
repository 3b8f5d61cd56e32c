"""Control barrier functions and distance from singular poses."""
