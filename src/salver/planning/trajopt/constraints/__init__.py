"""Constraints on a joint motion, as rows g <= 0 with derivatives."""
