"""Clips drawn with MuJoCo, with ground truth beside them, and the score of a reconstruction against that truth.

Nothing that a user installs imports this package: it trains the small networks and measures reconstruction.

Reading order: clips (`VideoSpec`, `random_spec`, `render`), story (who does what), props, shapes
    and textures (household things),
motion, grasp and hand, room and camera, truth (what is written beside a clip), score with
score_types and shape_overlap (stage by stage: is the scene right?).
"""
