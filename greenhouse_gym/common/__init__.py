"""Files, settings files, checks, progress, optional imports and executors, used by all other packages."""
