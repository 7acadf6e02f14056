"""Lights: what every light is (`light`), on the disk (`disk`), in the lab (`lab`); which one a movie has (`kinds`)."""
