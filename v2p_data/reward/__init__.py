"""One task code becomes the best reward found.

In: a `TaskBundle` and, where there is one, a model that writes. `search.RewardSearch` goes through rounds of them.
Each reward is a stage of the pipeline (`candidate`): PPO learns with it and its policy is judged. `feedback` says per
component what successful and failed episodes earned. From this text the model writes the next round. Out: the
`Candidate` that did best; its code differs from the task's in the reward only.
"""
