"""A folder of ordinary videos becomes clips: frames in memory, with what a person said about them.

Comes in: video files (`captions.VIDEO_SUFFIXES`), and captions from `captions.json` beside them, from a label
file of Something-Something-v2, or from the file names. Goes out: a `Clip` per video, RGB, upright, evenly
sampled and small enough for memory; or an `ItemRejectedError` that says why this video cannot be used.

Reading order: captions (which videos, what is said) with labels, hints and checked (JSON that people wrote), meaning
(what the words ask for), tracks (which stream is the film, which way up), decode (the pixels), clip (the result).
"""
