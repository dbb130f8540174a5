"""Friction from logs, and tilts of the tray that measure it."""
