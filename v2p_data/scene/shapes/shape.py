"""The mesh of an object: the primitive that was fitted, a solid of revolution, or the inflated silhouette, by outline.

The fit says where the object is and how large; here its outline says more: the neck of a bottle, the bulge of a bowl, a
banana's bend. The primitive stays unless another shape covers the outline clearly better, because a hand, a shadow or a
handle deforms outlines too. One view does not show the back: it is taken to be like the front.
"""

from dataclasses import dataclass, replace

import numpy as np
import trimesh
from jaxtyping import Float

from v2p_data.geometry.camera import Camera
from v2p_data.geometry.mesh import mesh_for, parts_for
from v2p_data.scene.frames.mask_ops import handle_of
from v2p_data.scene.scale.nouns import Noun
from v2p_data.scene.shapes.inflation import inflation
from v2p_data.scene.shapes.mesh_hypothesis import Kind, MeshHypothesis, Size, iou_of
from v2p_data.scene.shapes.revolved import revolution
from v2p_data.scene.shapes.silhouette_view import SilhouetteCrop, SilhouetteView

MARGINS = {"revolution": 0.025, "ball": 0.06, "irregular": -0.06, "regular": 0.15}
"""By how much another shape must cover the outline better than the primitive, in units of IoU: a
solid of revolution; one for round fruit, as noise dents most outlines of balls; an inflated
silhouette of what has no simple shape, there the primitive must win; and of anything else."""
_MIN_PX = 80
"""Fewest pixels of a mask; a smaller outline has no form."""
_MAX_HIDDEN = 0.25
"""Where more of the primitive than this is hidden, its outline is not trusted to say more."""
_OTHER_SIDES = 1.8
"""An inflated silhouette's sides are at most by this factor others than the fitted primitive's."""


@dataclass(frozen=True, kw_only=True)
class ShapeChoice:
    """The mesh that covers the outline best for what it costs."""

    kind: Kind
    mesh: trimesh.Trimesh
    """Closed, turned outwards, centred on its bounding box, in its own frame [m]."""
    parts: tuple[trimesh.Trimesh, ...]
    """Convex solids that together are the mesh; what is hollow stays free."""
    size_m: Size
    """The mesh's full extents."""
    T_obj_shape: Float[np.ndarray, "4 4"]
    """From the mesh's frame to the fitted primitive's: poses become `T_world_obj @ T_obj_shape`."""
    iou: float
    """Overlap of the mesh's silhouette with the mask where it can be seen."""
    reason: str
    """Why this shape, with the numbers."""


def best_shape(
    view: SilhouetteView,
    camera: Camera,
    size_m: Size,
    noun: Noun,
) -> ShapeChoice:
    """Return the mesh of an object that was fitted with its noun's primitive.

    Args:
        view: the object at rest on the table.
        camera: of the masks, in the world frame, the table's top at z = 0 [m].
        size_m: of the fitted primitive, along its own axes.
        noun: which primitive, whether hollow, whether irregular.
    """
    crop = SilhouetteCrop(view, camera)
    primitive = _primitive(size_m, noun)
    plain = iou_of(primitive, view, crop)
    hidden = crop.hidden_share(crop.drawn(primitive.mesh, view.T_world_obj))
    best, best_iou, best_gain = primitive, plain, 0.0
    reason = f"the {_word(noun)} covers the outline to {plain:.2f}"
    pixels = int(view.mask.sum())
    if pixels < _MIN_PX:
        reason += f"; with {pixels} pixels it is too small in the picture for anything finer"
    elif hidden > _MAX_HIDDEN:
        reason += f"; {hidden:.0%} of it is hidden, so nothing finer was tried"
    else:
        for candidate, margin in _others(view, crop, size_m, noun):
            if candidate.kind == "inflated" and not _as_large(candidate, size_m):
                continue
            iou = iou_of(candidate, view, crop)
            if iou - margin - plain > best_gain:
                best, best_iou, best_gain = candidate, iou, iou - margin - plain
        if best is not primitive:
            what = {"revolution": "a solid of revolution", "inflated": "the inflated silhouette"}
            reason = f"{what[best.kind]} covers the outline to {best_iou:.2f}, the {_word(noun)} to {plain:.2f}"
    x, y, z = (float(v) for v in best.mesh.extents)
    return ShapeChoice(
        kind=best.kind,
        mesh=best.mesh,
        parts=best.parts,
        size_m=(x, y, z) if best is not primitive else size_m,
        T_obj_shape=best.T_obj_shape,
        iou=best_iou,
        reason=reason,
    )


def _primitive(size_m: Size, noun: Noun) -> MeshHypothesis:
    return MeshHypothesis(
        kind="primitive",
        mesh=mesh_for(noun.form, size_m, hollow=noun.hollow, taper=noun.taper),
        parts=parts_for(noun.form, size_m, hollow=noun.hollow, taper=noun.taper),
        T_obj_shape=np.eye(4),
    )


def _others(
    view: SilhouetteView, crop: SilhouetteCrop, size_m: Size, noun: Noun
) -> list[tuple[MeshHypothesis, float]]:
    """Return what else the object may be, with the margin by which each must win."""
    found: list[tuple[MeshHypothesis | None, float]] = []
    if noun.form != "box":
        margin = MARGINS["revolution" if noun.form == "cylinder" else "ball"]
        body = crop
        if noun.handled:
            handle = handle_of(view.mask)
            unknown = handle if view.hidden is None else view.hidden | handle
            body = SilhouetteCrop(
                replace(view, mask=view.mask & ~handle, hidden=unknown), crop.camera
            )
        found.append((revolution(view, body, size_m, noun), margin))
    if not noun.hollow and noun.symmetry != "sphere" and not crop.at_border:
        irregular = noun.form == "box" and noun.symmetry == "none"
        margin = MARGINS["irregular" if irregular else "regular"]
        found.append((inflation(view, crop, size_m), margin))
    return [(candidate, margin) for candidate, margin in found if candidate is not None]


def _as_large(shape: MeshHypothesis, size_m: Size) -> bool:
    """Return whether its sides are about the fit's: seen aslant, what is flat can be inflated to any depth."""
    ratio = np.sort(shape.mesh.extents) / np.sort(size_m)
    return bool((np.maximum(ratio, 1 / ratio) < _OTHER_SIDES).all())


def _word(noun: Noun) -> str:
    hollow = "hollow " if noun.hollow else ""
    return hollow + {"box": "box", "cylinder": "cylinder", "sphere": "ball"}[noun.form]
