"""Commands that make plans: the demonstration, scenarios, plans, timings, trade-offs."""
