"""A language model writes task code and rewards: prompts, client, recorded calls, answers."""
