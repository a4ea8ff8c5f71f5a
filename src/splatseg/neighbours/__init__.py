"""Radius and k nearest neighbour search over points and centres of Gaussians, exact.

The search is ``native/neighbours.h``; its readable twin, which compares everything with everything,
is ``tests/support/neighbours_reference.py``.
"""

from splatseg.neighbours._index import NeighbourIndex as NeighbourIndex
from splatseg.neighbours._index import NeighbourLists as NeighbourLists
from splatseg.neighbours._index import Neighbours as Neighbours
from splatseg.neighbours._index import Subset as Subset
from splatseg.neighbours._index import ball_means as ball_means
