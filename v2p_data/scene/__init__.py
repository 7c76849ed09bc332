"""A clip becomes a scene: what moved where, how large it is, and how sure we are.

Comes in: a `video.clip.Clip` (frames, caption, object phrases, optional hints). Goes out: a `Reconstruction`, which
`export.write_scene` turns into a folder with `scene.json` (the paper's task JSON), `meshes/`, `masks/`, `urdf/`, `mjcf/`,
`scene.xml` (all objects in MJCF) and the overlay video; or an `ItemRejectedError` with a reason and the number that decided.

Nothing is downloaded: a small network of our own, trained on rendered clips only, says which pixels are hand, moved thing,
other thing and table; its weights, `network.safetensors`, lie beside `network.py`. Everything else is OpenCV, scipy and
trimesh. `--scene.ground.backend=heuristic` does without the network, and each stage can ask a learned model instead
(`backends/`, `docs/backends.md`). What the steps are, and how good they are: `docs/reconstruction.md`.

Reading order:
    reconstruct     the steps, in order; `SceneConfig`
    footage, colour, table      frames at working size, stills without passers-by, the bare table
    classes, network            the five classes, and the network that tells them apart
    sight           which pixels are which object in every frame: `find` and `stand` (network), `tool`, `ground` (heuristics) or
                    `marks` (a person's), then `segment` and `track`
    placement, pose             masks become camera, sizes and poses, in camera heights
    nouns, scale                usual sizes turn camera heights into metres; `one_camera` puts together what several clips say
    shape           primitive, solid of revolution (`revolved`) or inflated silhouette (`inflation`), with `handles`; a `spoon`
    learned, backends           where learned models and workers take part
    gate            how sure each stage is; does the motion fit the caption?
    scene, export, overlay      what is written
    review, score   a page for a person's judgement; the difference from a rendered clip's truth
"""
