"""A Franka arm that speaks the dataset's states and actions, as LeRobot robots: `v2p_franka`, and its twin `v2p_twin`.

LeRobot pairs `config_v2p_franka.V2PFrankaConfig` with `v2p_franka.V2PFranka` by their names, so keep them.
"""
