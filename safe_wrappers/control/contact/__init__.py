"""Contacts: complementarity, impacts, body regions, friction cones."""
