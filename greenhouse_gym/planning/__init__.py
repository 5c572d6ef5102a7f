"""Motion planning with OMPL: goals, collision model, planners, paths."""
