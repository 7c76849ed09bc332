"""A clip becomes a scene: what moved where, how large it is, and how sure we are.

Comes in: a `video.clip.Clip` (frames, caption, object phrases, optional hints). Goes out: a `Reconstruction`,
which `export.write_scene` turns into a folder with `scene.json` (the paper's task JSON), `meshes/*.obj`,
`urdf/*.urdf`, `scene.xml` (MJCF) and the overlay video. No neural weights: OpenCV, scipy and trimesh only, so
clean, colourful clips of a static camera go through and the rest is rejected with a reason and a number.

Reading order: reconstruct (the steps), footage, colour, table, ground, segment, track, nouns, pose, scale, overlay, export.
"""
