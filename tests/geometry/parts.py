"""How far points lie outside convex parts."""

import numpy as np


def outside(points: np.ndarray, parts) -> np.ndarray:
    """Return how far each point lies outside the nearest convex part [m]; negative inside."""
    far = np.full(len(points), np.inf)
    for part in parts:
        offset = np.einsum("fk,fk->f", part.face_normals, part.triangles[:, 0])
        far = np.minimum(far, (points @ part.face_normals.T - offset).max(axis=1))
    return far
