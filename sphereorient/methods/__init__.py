"""The methods, one page each, and their settings."""
