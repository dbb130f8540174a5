"""Commands that drive: a plan on an arm, a motion steered by hand."""
