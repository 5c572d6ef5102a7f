"""A procedural tomato row with known truth."""
