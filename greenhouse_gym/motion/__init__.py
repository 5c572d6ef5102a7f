"""Collision model, distance field, kinematics and roadmaps: what environments and planners both need."""
