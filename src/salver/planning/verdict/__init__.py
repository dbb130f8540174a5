"""The verdict on a joint motion: whether it keeps every constraint of its problem, for the whole uncertain set."""
