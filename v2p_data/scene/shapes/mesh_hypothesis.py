"""What the shape of an object may be, and how well it covers the object's outlines."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import trimesh
from jaxtyping import Float

from v2p_data.scene.shapes.silhouette_view import SilhouetteCrop, SilhouetteView

Kind = Literal["primitive", "revolution", "inflated"]
Size = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class MeshHypothesis:
    """A mesh that an object may have."""

    kind: Kind
    mesh: trimesh.Trimesh
    """Closed, in its own frame [m]."""
    parts: tuple[trimesh.Trimesh, ...]
    """Convex solids that together are the mesh."""
    T_obj_shape: Float[np.ndarray, "4 4"]
    """From the mesh's frame to the fitted primitive's."""


def iou_of(shape: MeshHypothesis, view: SilhouetteView, crop: SilhouetteCrop) -> float:
    """Return how well a shape covers the outline where it can be seen."""
    return crop.iou(crop.drawn(shape.mesh, view.T_world_obj @ shape.T_obj_shape))


def turned(mesh: trimesh.Trimesh, rotation: Float[np.ndarray, "3 3"]) -> trimesh.Trimesh:
    """Return a mesh turned about its origin."""
    return trimesh.Trimesh(mesh.vertices @ rotation.T, mesh.faces, process=False)
