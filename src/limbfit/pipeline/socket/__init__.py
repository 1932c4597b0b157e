"""The socket of a study: its shape, the limb in it, the loads on it with their intervals, its design."""
