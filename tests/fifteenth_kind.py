"""A fifteenth kind of task, `put_behind`, with all its parts; run as a process of its own by `test_kinds.py`.

It prints what each link of the chain made of it, as JSON. No checker of types runs here: `Kind` has fourteen names.
"""

import json
import sys
from dataclasses import replace
from typing import Any

import numpy as np

from v2p_data import kinds
from v2p_data.experts import teacher
from v2p_data.experts.primitives import Moment
from v2p_data.kinds import TaskKind
from v2p_data.sim.env.batch_env import BatchEnv
from v2p_data.sim.env.verdict import RefereeRecord
from v2p_data.task import referee
from v2p_data.task.benchmark import load_benchmark
from v2p_data.task.sandbox.sandbox import class_name
from v2p_data.task.templates import carrying, recipes
from v2p_data.task.templates.draft import Draft, Measured
from v2p_data.task.templates.variants import Variant
from v2p_data.task.templates.write import write_samples
from v2p_data.video.captions import parse_caption

NAME: Any = "put_behind"
ROW = TaskKind(
    name=NAME,
    phrases=(("put", "behind"),),
    family="carry",
    end="beside",
    other="needed",
    grasps="manipulated",
    programs=("put behind",),
)


def template(measured: Measured, variant: Variant) -> Draft:
    """The template of `drop_in_front_of`, mirrored."""
    draft = carrying.drop_in_front_of(measured, variant)
    draft.setup = [line.replace("-torch.ones_like", "torch.ones_like") for line in draft.setup]
    draft.success = [
        (name, text.replace("obj_pos[:, 0] < ref", "obj_pos[:, 0] > ref"))
        for name, text in draft.success
    ]
    return draft


def rule(case: referee.Case) -> np.ndarray:
    is_behind = case.thing.pos[-1, :, 0] > case.other.pos[-1, :, 0]
    return is_behind & (case.gap[-1] < 0.1) & case.thing.is_at_rest


def program(m: Moment, k: int) -> np.ndarray:
    obj, ref = m.bodies[0], m.bodies[k]
    goal = ref.pos.copy()
    goal[:, 0] += obj.size[:, :2].max(1) / 2 + ref.size[:, :2].max(1) / 2 + 0.02
    goal[:, 2] = obj.start[:, 2] + 0.002
    return teacher._put(m, goal, over_m=ref.top + 0.02, down_m=0.02)


def main() -> None:
    kinds.KINDS[NAME] = ROW
    recipes.RECIPES[NAME] = template
    referee.RULES[NAME] = rule
    teacher.WITH_OTHER["put behind"] = program

    read = parse_caption("Putting the matchbox behind the mug", ("matchbox", "mug"))
    known = load_benchmark("drop_in_front_of")
    scene = replace(known.scene, kind=read.kind)
    code = write_samples(scene, 1)[0]
    bundle = replace(known, kind=scene.kind, class_name=class_name(code), code=code, scene=scene)
    env = BatchEnv(bundle, num_envs=8, seed=1, num_threads=1)
    player = teacher.Teacher(env)
    best = player.choose(env)
    record = RefereeRecord(env)
    env.reset(np.arange(8))
    record.restart()
    for _ in range(env.horizon):
        env.step(player.act())
        record.note()
    said = {
        "kind": read.kind,
        "is_mirrored": "front = torch.ones_like" in code,
        "program": best.name,
        "task_success": best.success,
        "referee_success": float(record.verdict().mean()),
    }
    json.dump(said, sys.stdout)


main()
