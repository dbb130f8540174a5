"""Commands that move an arm: by a plan, or by hand in a simulation."""
