"""The command line, ``greenhouse-gym``."""
