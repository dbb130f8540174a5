"""Liquids in open containers: their modes, surface, crests and spills."""
