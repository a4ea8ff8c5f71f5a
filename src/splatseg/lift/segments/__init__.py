"""Segments of views, and which of them are of one thing."""
