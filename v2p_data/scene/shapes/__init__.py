"""An outline and a noun become a mesh with convex parts.

Comes in: one outline with the pose of its primitive [m]. Goes out: a mesh, its parts, and the reason for the choice.

Reading order: shape (which mesh is chosen), silhouette_view (a mesh compared with an outline),
    mesh_hypothesis, revolved (solids of
revolution), inflation (an outline is blown up), by_worker (a model of somebody else's).
"""
