"""Affinity features to a tree of instances, without a prompt."""
