"""Usual sizes of things turn camera heights into metres.

Comes in: fitted sizes in camera heights. Goes out: the camera's height [m] and how sure it is.

Reading order: nouns (`nouns.tsv`: size, mass and shape of household things), camera_height (every
    object's vote), shared_camera
(what several clips of one camera say together).
"""
