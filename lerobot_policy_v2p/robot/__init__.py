"""A Franka arm that speaks the dataset's states and actions, as a LeRobot robot of type `v2p_franka`.

LeRobot pairs `config_v2p_franka.V2PFrankaConfig` with `v2p_franka.V2PFranka` by their names, so keep them.
"""
