"""Requests of a live motion, and how it is planned anew: bent, replaced, led around moving obstacles."""
