"""Frame arithmetic: poses, cameras, meshes.

Right-handed frames, world +z up, camera axes as in OpenCV (x right, y down, z forward), metres, radians,
quaternions `wxyz`. `T_a_b` takes points from frame b to frame a, so inner names cancel.
"""
