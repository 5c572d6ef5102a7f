"""Readers of point cloud files, one module per format."""
