"""A clip becomes a scene: what moved where, how large it is, and how sure we are.

Comes in: a `video.clip.Clip` (frames, caption, object phrases, optional hints). Goes out: a `Reconstruction`, which
`export.write_scene` turns into a folder with `scene.json` (the paper's task JSON), `meshes/`,
`masks/`, `urdf/`, `mjcf/`, `scene.xml` (all objects in MJCF) and the overlay video; or an
`ItemRejectedError` with a reason and the number that decided.

Nothing is downloaded. A small network of our own, trained on rendered clips only, says which
pixels are hand, moved thing, other thing and table. Everything else is OpenCV, scipy and trimesh.
Each step can ask a learned model instead (`backends/`, `docs/backends.md`).

Rooms, each of which imports only those above it:
    backends        learned models and workers
    config          the settings; preset: what a preset and this machine choose
    scale           usual sizes turn camera heights into metres
    frames          working frames, colours, the table, and the network's classes for every pixel
    data_types      what the rooms below hand to each other
    grounding       which pixels are which object, in every frame
    shapes          an outline and a noun become a mesh
    fitting         masks become a camera, sizes and poses
Above them all:
    reconstruct     START HERE: the steps, in order
    meshes          every object gets its mesh
    confidence      how sure each step is; does the motion fit the caption?
    estimates       one named object in metres; remarks are the warnings
    export, overlay what is written
The artefact itself, which the rest of the engine reads: scene, schema, files.

What the steps are, and how good they are: `docs/reconstruction.md`.
"""
