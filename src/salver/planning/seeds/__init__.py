"""Where a search begins: postures at both ends, and paths from one to the other, past or around what stands there."""
