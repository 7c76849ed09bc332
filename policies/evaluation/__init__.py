"""How often a policy succeeds, with an interval."""
