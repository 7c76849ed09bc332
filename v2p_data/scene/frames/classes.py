"""What the scene network tells apart. By itself, so that knowing the names does not import torch."""

CLASSES = ("background", "table", "hand", "moved", "other")
"""`moved` is whatever lies elsewhere at the end, tools too; `other` stands still the whole time."""
BACKGROUND, TABLE, HAND, MOVED, OTHER = range(5)
LONG_SIDE_PX = 256
"""Of the pictures that the scene network looks at."""
