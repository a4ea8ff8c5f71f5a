"""Votes of pixels and segments on the Gaussians they show, and labels from them."""
