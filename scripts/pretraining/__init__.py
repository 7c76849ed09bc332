"""How the experts that are shipped were learned: many random objects a kind, one network for all of them."""
