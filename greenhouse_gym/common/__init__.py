"""Files, settings files, checks, progress, optional imports and executors: what every other package stands on."""
