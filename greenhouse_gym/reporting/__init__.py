"""Pictures, films and HTML pages: clouds, shapes, scenes, reconstructions and comparisons."""
