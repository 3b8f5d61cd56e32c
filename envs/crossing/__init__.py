"""Parts of the crossing and of the patrolled maze."""
