"""Worlds of one task in step: what randomisation draws, what actions do, what policies and the referee see.

`batch_env.BatchEnv` simulates on CPU cores or, for training, on a GPU. `randomize` draws what
differs from episode to episode.
"""
