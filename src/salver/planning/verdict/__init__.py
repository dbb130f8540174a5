"""The verdict on a joint motion: whether it meets every constraint of its problem for the whole uncertain set."""
