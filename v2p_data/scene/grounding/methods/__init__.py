"""Who says where an object is, beside the scene network: each method marks what a phrase means in one frame.

`base` holds what a method is. A person's marks are `hint`, a detector's boxes `detector`. A method
that comes later goes before the earlier ones. To add a detector: its model in
`v2p_data/scene/backends/detect.py`, its name in `backends/config.py`.
"""
