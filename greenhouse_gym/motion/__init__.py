"""Collision model, distance field, kinematics and roadmaps, used by environments and planners."""
