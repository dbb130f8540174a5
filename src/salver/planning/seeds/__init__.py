"""Initial guesses of a search: postures at both ends, and paths between them, straight or around obstacles."""
