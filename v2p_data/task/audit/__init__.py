"""Success functions, resets and rewards are checked against the video before anything trains on them."""
