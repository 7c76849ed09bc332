"""Experts become a LeRobot dataset.

In: a `TaskBundle` and an expert (any function from observations to actions). First, successful rollouts are
staged, one atomic `episodes/<id>.npz` each, with `rejected.jsonl` and a ledger of finished batches beside them
(`collect.collect`). Then `writer.pack` turns staged episodes into one LeRobot v3 dataset, `verify.verify`
reopens it and compares every frame, `card.write_card` describes it and `hub` pushes it, or its tasks as `envhub`.
`edit` merges datasets and drops tasks, `explain` reads back where one comes from. LeRobot itself is imported
inside the functions that need it: importing it takes many seconds.
"""
