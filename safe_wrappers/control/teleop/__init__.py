"""Passivity over a network: energy ledgers, wave variables, passivity controller."""
