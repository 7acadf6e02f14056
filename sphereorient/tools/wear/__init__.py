"""Changes of a texture map over a series of movies."""
