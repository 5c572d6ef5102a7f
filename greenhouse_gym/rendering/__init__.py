"""Images of scenes: ray casting, OpenGL and the viewer."""
