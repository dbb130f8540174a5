"""What moves inside a load, along a motion: its state, what it pushes, and what it must keep. A liquid, a pendulum."""
