"""The methods, a page each, and their settings."""
