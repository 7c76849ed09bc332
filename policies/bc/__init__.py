"""Behaviour cloning as a LeRobot policy, type `v2p_bc`.

In: a LeRobot dataset with one or more cameras, usually a state, and an action. Out: a checkpoint folder that
`lerobot-train`, `lerobot-eval` and `lerobot-rollout` read. LeRobot finds the three modules by their names
(`configuration_`, `modeling_`, `processor_`), so keep them. Importing this package imports nothing heavy.
"""
