"""Tomatoes: spheres and ellipsoids, grouped into trusses."""
