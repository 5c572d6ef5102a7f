"""From a recording to one cloud of the row, and its mesh."""
