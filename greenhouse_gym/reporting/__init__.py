"""Pictures and pages for people: drawings of clouds, shapes and scenes, and the report of a row."""
