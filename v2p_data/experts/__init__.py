"""A task becomes an expert: a neural network that solves it, from the simulator's states.

Comes in: a `TaskBundle` and the settings of `config`. Goes out: a folder with the expert's weights, the curve of its
training, and `taught/`, the policy that imitation gave. Reading order:

    primitives   scripted motions: reach, grasp, carry, push, throw
    teacher      scripted policies made of them, and the search for the best one
    labeller     who demonstrates and labels: the network, or a program itself
    learning     the three steps: teach, improve by PPO, keep the better one
"""
