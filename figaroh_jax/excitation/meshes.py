"""Distances between the exact shapes of a robot's bodies, by coal (extra `collision`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from ..formats.collision import Shape

__all__ = ["mesh_distance"]


def mesh_distance(links: Sequence[Any]) -> Callable[..., Float[np.ndarray, "samples pairs"]] | None:
    """Distances (m) of pairs of links at poses of all joint frames; None without coal. Zero or less: they touch."""
    try:
        import coal  # pyright: ignore[reportMissingImports]
    except ImportError:
        return None
    made: dict[int, list[tuple[Any, np.ndarray]]] = {}

    def of(link: int) -> list[tuple[Any, np.ndarray]]:
        if link not in made:
            made[link] = [(_geometry(coal, shape), shape.pose) for shape in links[link].shapes]
        return made[link]

    request, result = coal.DistanceRequest(), coal.DistanceResult()

    def distances(poses: Float[np.ndarray, "links 4 4 samples"], pairs: Sequence[tuple[int, int]]) -> np.ndarray:
        out = np.full((poses.shape[3], len(pairs)), np.inf)
        for s in range(poses.shape[3]):
            for p, (i, j) in enumerate(pairs):
                first, second = (_placed(coal, of(k), links[k].joint, poses, s) for k in (i, j))
                for a, A in first:
                    for b, B in second:
                        result.clear()
                        out[s, p] = min(out[s, p], coal.distance(a, A, b, B, request, result))
        return out

    return distances


def _placed(coal: Any, geometries: Sequence[tuple[Any, np.ndarray]], joint: int, poses: np.ndarray, s: int) -> Any:
    world = np.eye(4) if joint < 0 else poses[joint][..., s]
    placed = [(geometry, world @ pose) for geometry, pose in geometries]
    return [(geometry, coal.Transform3s(pose[:3, :3], pose[:3, 3])) for geometry, pose in placed]


def _geometry(coal: Any, shape: Shape) -> Any:
    if shape.kind == "box":
        return coal.Box(*(2 * x for x in shape.size))
    if shape.kind == "sphere":
        return coal.Sphere(*shape.size)
    if shape.kind in ("cylinder", "capsule"):
        kind = coal.Cylinder if shape.kind == "cylinder" else coal.Capsule
        return kind(shape.size[0], 2 * shape.size[1])
    assert shape.vertices is not None and shape.faces is not None
    mesh = coal.BVHModelOBBRSS()
    mesh.beginModel(len(shape.faces), len(shape.vertices))
    mesh.addVertices(np.asarray(shape.vertices, float))
    mesh.addTriangles(np.asarray(shape.faces))
    mesh.endModel()
    return mesh
