"""Gaussians at the boundaries of labels: split, cut and refitted."""
