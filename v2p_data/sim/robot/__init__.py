"""The arm: the built-in one, any other in MJCF, and how its fingers hold things."""
