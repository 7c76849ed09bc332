"""Tasks as environments that others know: Gymnasium, its vector environments, TorchRL, LeRobot."""
