"""Clearances that are kept by a backup manoeuvre."""
