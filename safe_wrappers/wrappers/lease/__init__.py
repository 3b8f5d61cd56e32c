"""Parts of LeaseExpiry."""
