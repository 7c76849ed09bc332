"""Studies that drive the engine's stages many times over: what a generalist policy owes to its training objects.

In: `configs/studies/lifting_*.yaml`, a folder of meshes for the evaluation, and optionally one of real clips. Out: one
JSON line a cell (arm, number of training tasks, seed), then tables.

Read `config` (arms and sizes), `objects` (where training and evaluation objects come from), `cells` (one cell's
policy and its judgement), then `fits` and `table` (what the lines say together).
"""
