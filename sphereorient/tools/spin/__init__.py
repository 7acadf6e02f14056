"""Spin from photographs of a ball with dots."""
