"""Recordings of a row: frames, rigs, readers and writer, the simulated rig."""
