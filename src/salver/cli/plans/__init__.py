"""Commands that make plans: demonstration, scenarios, plans, timings."""
