"""Clutter: oriented boxes around everything that is neither fruit nor stem."""
