"""Who says where an object is, beside the scene network: each method marks what a phrase means in one frame.

`base` holds what a method is. A person's marks are `hint`, a detector's boxes `detector`. Marks
of a person go before boxes of a detector. To add a detector: its name and default model in
`v2p_data/scene/backends/config.py`, its class in `backends/checkpoint.py`, and a branch in
`backends/detect.py` that reads its answer. A worker needs no file of ours.
"""
