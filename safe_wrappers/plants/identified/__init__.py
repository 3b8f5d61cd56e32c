"""A plant whose dynamics are fitted to logged steps, and whose errors are measured on others."""
