"""A complete worker, to be copied: it keeps the contract of docs/workers.md with numpy and trimesh alone.

    python scripts/example_worker.py --request DIR --result DIR

It answers `mesh` by inflating the outline and `depth` by a table seen from a usual camera. Put the model's own calls in
the place of `inflate` and `table_depth` and run it with the model's own Python.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import trimesh

SCHEMA, VERSION = "v2p-worker", 1
BAD_REQUEST, REFUSED = 2, 3
CELLS = 48
"""Along the longer side of an outline."""
FOV_RAD, PITCH_RAD, HEIGHT_M, FARTHEST_M = 1.01, 0.61, 0.5, 10.0


class RefusedError(Exception):
    """This item cannot be done; another may."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--request", type=Path, required=True)
    parser.add_argument("--result", type=Path, required=True)
    args = parser.parse_args()
    request = json.loads((args.request / "request.json").read_text(encoding="utf-8"))
    kind = request["kind"]
    if (request["schema"], request["version"]) != (SCHEMA, VERSION) or kind not in ANSWERS:
        print(
            f"this worker does {sorted(ANSWERS)} of version {VERSION}, not {kind}", file=sys.stderr
        )
        return BAD_REQUEST
    with np.load(args.request / "arrays.npz", allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    head: dict[str, Any] = {"schema": SCHEMA, "version": VERSION, "kind": kind}
    try:
        fields, answer, mesh = ANSWERS[kind](arrays)
    except RefusedError as reason:
        (args.result / "result.json").write_text(
            json.dumps({**head, "message": str(reason)}), encoding="utf-8"
        )
        return REFUSED
    if answer:
        np.savez(args.result / "result.npz", **answer)
    if mesh is not None:
        mesh.export(args.result / "mesh.obj")
    (args.result / "result.json").write_text(
        json.dumps({**head, "fields": fields}), encoding="utf-8"
    )
    return 0


def answer_mesh(arrays: dict[str, np.ndarray]) -> tuple[dict, dict, "trimesh.Trimesh"]:
    if arrays["mask"].sum() < 16:
        raise RefusedError(f"the outline has {arrays['mask'].sum()} pixels, too few for a shape")
    return {"metric": False}, {}, inflate(arrays["mask"])


def answer_depth(arrays: dict[str, np.ndarray]) -> tuple[dict, dict, None]:
    count, h, w = arrays["images"].shape[:3]
    depth = np.repeat(table_depth(h, w)[None], count, axis=0)
    return {"metric": True}, {"depth_m": depth, "fov_rad": np.full(count, FOV_RAD)}, None


def inflate(mask: np.ndarray) -> "trimesh.Trimesh":
    """Return a closed cushion with the outline of the mask: x towards the camera, y right, z up in the picture."""
    import trimesh  # here, so that the other kinds do not wait for it

    y, x = np.nonzero(mask)
    side = max(np.ptp(x), np.ptp(y)) + 1
    step = max(1, round(side / CELLS))
    cells = np.pad(mask[y.min() : y.max() + 1, x.min() : x.max() + 1], step)[
        step // 2 :: step, step // 2 :: step
    ]
    cells = np.pad(cells, 1)
    # Two cells that touch at a corner only would share an edge with four faces.
    for _ in range(cells.size):
        a, b, c, d = cells[:-1, :-1], cells[:-1, 1:], cells[1:, :-1], cells[1:, 1:]
        pinched = (a & d & ~b & ~c) | (b & c & ~a & ~d)
        if not pinched.any():
            break
        cells[:-1, :-1] |= pinched
        cells[:-1, 1:] |= pinched
    # A corner's depth inside: how often the outline can be shaved off before it goes.
    inside = np.ones((cells.shape[0] + 1, cells.shape[1] + 1))
    layer = cells.copy()
    while layer.any():
        for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
            inside[i : i + cells.shape[0], j : j + cells.shape[1]] += layer / 4
        p = np.pad(layer, 1)
        layer = layer & p[:-2, 1:-1] & p[2:, 1:-1] & p[1:-1, :-2] & p[1:-1, 2:]
    thick = np.sqrt(inside)
    rows, columns = np.indices(thick.shape)
    front = np.stack([thick, columns, -rows], axis=-1).reshape(-1, 3).astype(float)
    back = front * [-1, 1, 1]
    n, width = len(front), thick.shape[1]

    def corner(i: np.ndarray, j: np.ndarray) -> np.ndarray:
        return i * width + j

    def quads(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
        return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])

    i, j = np.nonzero(cells)
    square = corner(i, j), corner(i + 1, j), corner(i + 1, j + 1), corner(i, j + 1)
    faces = [quads(*square), quads(*(s + n for s in reversed(square)))]
    for di, dj, ends in ((-1, 0, (0, 3)), (1, 0, (2, 1)), (0, -1, (1, 0)), (0, 1, (3, 2))):
        rim = ~cells[i + di, j + dj]
        a, b = square[ends[0]][rim], square[ends[1]][rim]
        faces.append(quads(a, b, b + n, a + n))
    mesh = trimesh.Trimesh(np.concatenate([front, back]), np.concatenate(faces))
    mesh.fix_normals()
    mesh.vertices = (mesh.vertices - mesh.bounds.mean(0)) / mesh.extents.max()
    return mesh


def table_depth(h: int, w: int) -> np.ndarray:
    """Return the depth [m] of a table seen from a camera above it; what is over the horizon is far away."""
    focal = 0.5 * w / np.tan(FOV_RAD / 2)
    v = (np.arange(h) + 0.5 - h / 2) / focal
    falls = np.cos(PITCH_RAD) * v + np.sin(PITCH_RAD)
    depth = np.where(falls > HEIGHT_M / FARTHEST_M, HEIGHT_M / np.maximum(falls, 1e-6), FARTHEST_M)
    return np.repeat(depth[:, None], w, axis=1)


ANSWERS = {"mesh": answer_mesh, "depth": answer_depth}

if __name__ == "__main__":
    raise SystemExit(main())
