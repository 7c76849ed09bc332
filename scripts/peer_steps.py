"""Print how many control steps a second one process makes in another project's lifting environment.

    python scripts/peer_steps.py gym-hil 10
    python scripts/peer_steps.py robosuite 10

Random actions, observations of states and no images, resets included: as their users run them. It needs that
project and nothing of ours, so it can run in an interpreter of its own. The line it prints is JSON.
"""

import json
import os
import sys
import time
from collections.abc import Callable

import numpy as np


def gym_hil() -> tuple[Callable[[], bool], Callable[[], object], float]:
    """Return a step that says whether the episode is over, a reset, and the control period [s]."""
    os.environ.setdefault("MUJOCO_GL", "egl")  # it makes a renderer, also without images
    import gym_hil  # noqa: F401  # pyright: ignore[reportMissingImports]
    import gymnasium

    env = gymnasium.make("gym_hil/PandaPickCubeBase-v0", image_obs=False)

    def step() -> bool:
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        return bool(terminated or truncated)

    return step, env.reset, float(env.unwrapped.control_dt)  # pyright: ignore[reportAttributeAccessIssue]


def robosuite() -> tuple[Callable[[], bool], Callable[[], object], float]:
    """Return the same of robosuite's `Lift` with a Panda."""
    import robosuite  # pyright: ignore[reportMissingImports]

    env = robosuite.make(
        "Lift",
        robots="Panda",
        has_renderer=False,
        has_offscreen_renderer=False,
        use_camera_obs=False,
        reward_shaping=True,
        control_freq=20,
        horizon=100,
    )
    low, high = env.action_spec
    rng = np.random.default_rng(0)

    def step() -> bool:
        _, _, is_done, _ = env.step(rng.uniform(low, high))
        return bool(is_done)

    return step, env.reset, 1.0 / env.control_freq


def main(name: str, seconds: float) -> None:
    step, reset, control_dt_s = {"gym-hil": gym_hil, "robosuite": robosuite}[name]()
    reset()
    started, count = time.perf_counter(), 0
    while time.perf_counter() - started < seconds:
        count += 1
        if step():
            reset()
    rate = count / (time.perf_counter() - started)
    print(json.dumps({"steps_per_s": rate, "control_dt_s": control_dt_s}), flush=True)


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]))
