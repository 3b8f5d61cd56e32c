"""How long a command may be executed, and what late ones cost: leases, ceilings, reachability, sampling."""
