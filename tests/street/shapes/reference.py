"""Readable twins: one mesh, one pair, one number at a time."""

import math
from fractions import Fraction

import numpy as np

Point = tuple[Fraction, ...]


def chamfer(a: np.ndarray, b: np.ndarray, *, power: int) -> float:
    """Each point to the nearest of the other set, by Python's own distances."""
    to_b = [min(math.dist(x, y) for y in b) ** power for x in a]
    to_a = [min(math.dist(x, y) for x in a) ** power for y in b]
    return sum(to_b) / len(to_b) + sum(to_a) / len(to_a)


def regularisers(vertices: np.ndarray, faces: np.ndarray) -> tuple[float, float, float]:
    """Normal consistency, Laplacian and edge length of one mesh."""
    normals = []
    neighbours: dict[int, set[int]] = {}
    owners: dict[frozenset[int], list[int]] = {}
    for number, face in enumerate(faces.tolist()):
        a, b, c = (vertices[i] for i in face)
        normals.append(np.cross(b - a, c - a))
        for i, j in ((face[0], face[1]), (face[1], face[2]), (face[2], face[0])):
            owners.setdefault(frozenset((i, j)), []).append(number)
            neighbours.setdefault(i, set()).add(j)
            neighbours.setdefault(j, set()).add(i)
    bends, lengths = [], []
    for edge, (one, two) in owners.items():
        p, q = normals[one], normals[two]
        bends.append(1 - p @ q / (np.linalg.norm(p) * np.linalg.norm(q)))
        i, j = edge
        lengths.append(float(((vertices[i] - vertices[j]) ** 2).sum()))
    pulls = [
        np.linalg.norm(np.mean([vertices[j] for j in near], axis=0) - vertices[i])
        for i, near in neighbours.items()
    ]
    return float(np.mean(bends)), float(np.mean(pulls)), float(np.mean(lengths))


def self_intersections(vertices: np.ndarray, faces: np.ndarray) -> int:
    """Pairs of faces that share no vertex and meet, in exact arithmetic."""
    exact = [tuple(Fraction(float(x)) for x in vertex) for vertex in vertices]
    rows = faces.tolist()
    return sum(
        not set(one) & set(two) and meet([exact[i] for i in one], [exact[i] for i in two])
        for number, one in enumerate(rows)
        for two in rows[number + 1 :]
    )


def meet(a: list[Point], b: list[Point]) -> bool:
    """Two triangles have a point in common if no plane of a few kinds has them on both sides.

    Separating axes of convex polygons: normals, products of edges, and, where both lie in one
    plane, normals of edges within it.
    """
    along = [[minus(t[(i + 1) % 3], t[i]) for i in range(3)] for t in (a, b)]
    normals = [cross(edges[0], edges[1]) for edges in along]
    axes = list(normals)
    axes += [cross(e, f) for e in along[0] for f in along[1]]
    axes += [cross(normals[k], e) for k in (0, 1) for e in along[k]]
    for axis in axes:
        if not any(axis):
            continue
        p, q = ([dot(axis, x) for x in t] for t in (a, b))
        if max(p) < min(q) or max(q) < min(p):
            return False
    return True


def minus(p: Point, q: Point) -> Point:
    return tuple(x - y for x, y in zip(p, q, strict=True))


def cross(p: Point, q: Point) -> Point:
    return (p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0])


def dot(p: Point, q: Point) -> Fraction:
    return sum((x * y for x, y in zip(p, q, strict=True)), Fraction(0))
