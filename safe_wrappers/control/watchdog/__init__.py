"""How long a command may be executed: leases, round-trip ceilings, reachability in time."""
