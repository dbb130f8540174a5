"""Pictures: figures for a paper, a film."""
