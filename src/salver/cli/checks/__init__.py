"""Commands that check: runs in the physics engine, campaigns of them, audits."""
