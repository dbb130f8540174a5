"""The verdict on a live motion: what is committed, and what it must pass before."""
