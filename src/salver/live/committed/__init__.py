"""What a live motion is committed to: a verified motion to rest, its speed along its path, and its seal."""
