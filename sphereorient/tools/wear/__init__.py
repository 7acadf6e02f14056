"""How a texture map changes over a series of movies."""
