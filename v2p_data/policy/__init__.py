"""A dataset becomes a policy: rounds of distillation, then a last training on all frames."""
