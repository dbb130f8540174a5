"""What a robot did with a plan: the executed motion, its deviation, the corrected command."""
