"""A scene becomes one MuJoCo model: meshes as convex solids, bodies, joints; and whether the scene suits the robot."""
