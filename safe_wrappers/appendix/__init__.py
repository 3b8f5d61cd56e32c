"""Formulas of the appendix that no wrapper needs: kept and tested, outside the core."""
