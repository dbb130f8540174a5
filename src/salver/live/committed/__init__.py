"""The committed motion of a live motion: verified, ending at rest, with its speed along its path and its seal."""
