"""Lights: on the disk (`disk`), in the lab (`lab`); the choice between them (`kinds`)."""
