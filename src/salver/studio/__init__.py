"""A page on which a task is designed by hand: its scenario is edited, its margin is seen to move, and it is planned."""
