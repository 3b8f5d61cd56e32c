"""Balance: momentum, zero moment point, support, whole-body program."""
