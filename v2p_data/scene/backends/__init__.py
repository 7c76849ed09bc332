"""Learned models for the stages of reconstruction, one option each.

Detector, tracker, depth, mesh and pose are off by default. Outlines are used where they are set up.

Comes in: RGB pictures (uint8, `h w 3`) and phrases, boxes or masks in pixels of these pictures. Goes out: boxes
(`detect`), mask tracks (`segment`), metric depth and the table plane under it (`depth`), or what a model in an
environment of its own answered (`worker`: meshes, poses, and any of the former). Nothing lies on disk here but a
worker's request and result, in a temporary folder. Only `config` may be imported lightly: the others load torch and
transformers when they are called, not before. Default checkpoints, licences and memory are in `docs/backends.md`.

Reading order: config, checkpoint (how a model is loaded), detect, segment, depth, worker,
    pinned_packages (how what is set up beside ours is installed), outlines (prompts and masks), mobile_sam_setup (its
weights), mobile_sam, tiny_vit (its encoder).
"""
