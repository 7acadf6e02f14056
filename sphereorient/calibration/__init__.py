"""Cameras from pictures of a plate, from points, and from the sphere itself."""
