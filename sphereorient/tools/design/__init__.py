"""Texture maps to paint on a ball: patterns, their quality, strips to print."""
