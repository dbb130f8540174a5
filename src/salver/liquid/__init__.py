"""Liquids that are carried in open containers: their waves along a motion, what these push, and where they stand."""
