"""How well something does a task: many episodes at once, an independent judge, and what went wrong in the others.

In: a task and whoever acts in it: a policy that sees masks, an expert or a program that sees the
    simulator's states. Out:
`Judged`, from which the stage writes `evaluation.json`, films and a contact sheet. Policies are loaded elsewhere
(`policies.evaluation`); here they are anything with `reset` and `act`.
"""
