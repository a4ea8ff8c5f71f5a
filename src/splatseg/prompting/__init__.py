"""Prompts become selections: points, boxes, scribbles, masks, solids, and things like another."""
