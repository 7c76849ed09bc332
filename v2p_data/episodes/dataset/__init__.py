"""A LeRobot dataset on disk: written, verified, explained, merged and cut."""
