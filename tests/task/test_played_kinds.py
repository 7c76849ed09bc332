"""Each kind of task, played in the real physics by arms that do what its words say, and by arms that do not."""

import contextlib
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from v2p_data.errors import ItemRejectedError
from v2p_data.experts.primitives import Moment
from v2p_data.kinds import KINDS
from v2p_data.sim.env import ranges
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig
from v2p_data.sim.env.start_check import check_poses, check_start
from v2p_data.task.benchmark import load_benchmark
from v2p_data.task.task import Task, TaskBundle

sys.path.insert(0, str(Path(__file__).parent))
import played
from played import BACK, FORWARD, LEFT, RIGHT, bring, idle, let_go, program, rise, shove, take

pytestmark = pytest.mark.slow
WORLDS = 4
BESIDE = 0.12


def carry(*places: played.Phase, lift_m: float = 0.1) -> list[played.Phase]:
    """Take the object, raise it, bring it to places and let go."""
    return [take(), bring(z=lift_m), *places, let_go()]


PUSHES = {
    "nothing": (False, [idle()]),
    "too short": (False, [shove(LEFT, 0.04)]),
    "to the other side": (False, [shove(RIGHT)]),
    "forward": (False, [shove(FORWARD)]),
    "back": (False, [shove(BACK)]),
    "gripped and dragged": (False, [take(), bring(y=0.11), let_go()]),
    "dragged and held": (False, [take(), bring(y=0.11)]),
    "carried 2 cm high": (False, carry(bring(y=0.11, z=0.02), bring(y=0.11), lift_m=0.02)),
    "carried 8 cm high": (False, carry(bring(y=0.11, z=0.08), bring(y=0.11), lift_m=0.08)),
    "held in the air": (False, [take(), bring(z=0.04), bring(y=0.11, z=0.02)]),
    "half dragged": (False, [take(), bring(y=0.05), let_go(), shove(LEFT, 0.11)]),
    "dropped there": (False, [take(), bring(z=0.05), bring(y=0.11, z=0.05), let_go()]),
    "pushed": (True, [shove(LEFT)]),
    "pushed in two goes": (True, [shove(LEFT, 0.05), rise(), shove(LEFT)]),
}
NEXT_TO = {
    "nothing": (False, [idle()]),
    "too short": (False, [shove(towards=1, gap_m=0.06)]),
    "away": (False, [shove(RIGHT)]),
    "into it, on and on": (False, [shove(towards=1, gap_m=-0.06)]),
    "the other one": (False, [shove(of=1, towards=0)]),
    "carried": (False, carry(bring(to=1, y=-BESIDE, z=0.1), bring(to=1, y=-BESIDE))),
    "held in the air": (False, [take(), bring(z=0.04), bring(to=1, y=-0.085, z=0.03)]),
    "pushed": (True, [shove(towards=1)]),
}
IN_FRONT = {
    "nothing": (False, [idle()]),
    "lifted, set down, pushed": (False, [*carry(bring(), lift_m=0.06), rise(), shove(towards=1)]),
    "pushed": (False, [shove(towards=1)]),
    "gripped and dragged": (False, [take(), bring(to=1, x=-0.1), let_go()]),
    "still held": (False, [take(), bring(z=0.1), bring(to=1, x=-0.1, z=0.1), bring(to=1, x=-0.1)]),
    "behind": (False, carry(bring(to=1, x=0.1, z=0.12), bring(to=1, x=0.1), lift_m=0.12)),
    "lifted in place": (False, carry(bring())),
    "the other one put behind": (
        False,
        [take(of=1), bring(of=1, z=0.05), bring(of=1, x=0.05, z=0.05)],
    ),
    "dragged most of the way": (
        False,
        [
            take(),
            bring(to=1, x=-0.13),
            bring(to=1, x=-0.13, z=0.05),
            bring(to=1, x=-0.1),
            let_go(),
        ],
    ),
    "put down": (True, carry(bring(to=1, x=-0.1, z=0.1), bring(to=1, x=-0.1))),
    "dropped from 3 cm": (True, carry(bring(to=1, x=-0.1, z=0.1), bring(to=1, x=-0.1, z=0.03))),
}
INTO = {
    "nothing": (False, [idle()]),
    "pushed against it": (False, [shove(towards=1, gap_m=-0.03)]),
    "still held": (False, [take(), bring(z=0.12), bring(to=1, z=0.12), bring(to=1, z=0.03)]),
    "held above": (False, [take(), bring(z=0.12), bring(to=1, z=0.12)]),
    "beside": (False, carry(bring(to=1, y=-0.2, z=0.12), bring(to=1, y=-0.2))),
    "lifted in place": (False, carry(bring())),
    "the container moved": (False, [shove(LEFT, of=1)]),
    "put in": (True, carry(bring(to=1, z=0.12), bring(to=1, z=0.03), lift_m=0.12)),
    "dropped in": (True, carry(bring(to=1, z=0.12), lift_m=0.12)),
}
SCRIPTS = {
    "lift_up": {
        "nothing": (False, [idle()]),
        "taken": (False, [take()]),
        "not high enough": (False, [take(), bring(z=0.05)]),
        "let go on the way up": (False, [take(), bring(z=0.3, steps=4), let_go(), idle(20)]),
        "lifted and put down": (False, [take(), bring(z=0.04), bring(), let_go()]),
        "dragged": (False, [take(), bring(y=0.1)]),
        "pushed": (False, [shove(LEFT)]),
        "raised empty": (False, [rise()]),
        "lifted": (True, [take(), bring(z=0.12), idle(10)]),
        "lifted aside": (True, [take(), bring(y=0.08, z=0.12), idle(10)]),
    },
    "push_left": PUSHES,
    "push_left, 13 cm": {
        "pushed by the palm": (True, [shove(LEFT)]),
        "pushed by the fingers": (True, [shove(LEFT, high=0.4)]),
        "pushed too short by the palm": (False, [shove(LEFT, 0.04)]),
    },
    "push_right": {
        "pushed": (True, [shove(RIGHT)]),
        "to the other side": (False, [shove(LEFT)]),
        "carried 2 cm high": (False, carry(bring(y=-0.11, z=0.02), bring(y=-0.11), lift_m=0.02)),
    },
    "tip_over": {
        "nothing": (False, [idle()]),
        "lifted": (False, [take(), bring(z=0.1), idle(5)]),
        "lifted and put down": (False, carry(bring())),
        "tipped": (True, [shove(LEFT, 0.1, high=0.8, steps=45), rise()]),
        "tipped the other way": (True, [shove(RIGHT, 0.1, high=0.8, steps=45), rise()]),
    },
    "push_next_to": NEXT_TO,
    "slide_to": NEXT_TO
    | {
        "gripped and dragged": (True, [program("drag next to")]),
    },
    "push_with": {
        "nothing": (False, [idle()]),
        "by hand": (False, [shove(LEFT)]),
        "the tool taken, then by hand": (
            False,
            [take(of=1), bring(of=1, z=0.02), let_go(of=1), shove(LEFT)],
        ),
        "the tool alone": (False, [take(of=1), bring(of=1, z=0.1), bring(of=1, x=0.1, z=0.1)]),
        "the object carried": (False, carry(bring(y=0.1, z=0.1), bring(y=0.1))),
        "the tool pushed by hand": (False, [shove(of=1, towards=0, gap_m=-0.1, steps=90)]),
        "pushed with it": (True, [program("push with", 120)]),
    },
    "drop_in_front_of": IN_FRONT,
    "insert": INTO,
    "place_onto": INTO
    | {
        "put in": (True, carry(bring(to=1, z=0.08), bring(to=1, z=0.042), lift_m=0.08)),
        "dropped in": (True, carry(bring(to=1, z=0.06), lift_m=0.08)),
        "still held": (False, [take(), bring(z=0.08), bring(to=1, z=0.08), bring(to=1, z=0.043)]),
    },
    "throw_into": {
        "nothing": (False, [idle()]),
        "dropped": (False, carry(lift_m=0.15)),
        "pushed": (False, [shove(FORWARD, 0.2)]),
        "flung aside": (False, [take(), bring(z=0.15), bring(y=0.3, z=0.3, steps=5), let_go()]),
        "thrown": (True, [program("throw into")]),
    },
    "cover": {
        "nothing": (False, [idle()]),
        "pushed against it": (False, [shove(towards=1, gap_m=-0.05)]),
        "still held": (False, [take(), bring(z=0.08), bring(to=1, z=0.08), bring(to=1)]),
        "beside": (False, carry(bring(to=1, y=-BESIDE, z=0.08), bring(to=1, y=-BESIDE))),
        "lifted in place": (False, carry(bring())),
        "held above": (False, [take(), bring(z=0.08), bring(to=1, z=0.08)]),
        "put over": (True, carry(bring(to=1, z=0.08, steps=40), bring(to=1), lift_m=0.08)),
    },
    "uncover": {
        "nothing": (False, [idle()]),
        "pushed with what is in it": (False, [shove(LEFT, 0.12)]),
        "lifted a little": (False, [take(), bring(z=0.04)]),
        "lifted and put back": (False, carry(bring(z=0.05), bring(), lift_m=0.05)),
        "dragged with what is in it": (False, [take(), bring(y=0.12), let_go()]),
        "held high": (True, [take(), bring(z=0.14), idle(5)]),
        "put beside": (True, carry(bring(y=0.14, z=0.1), bring(y=0.14))),
    },
    "generic": {
        "nothing": (False, [idle()]),
        "too short": (False, [shove(LEFT, 0.05)]),
        "to the other side": (False, [shove(RIGHT)]),
        "pushed": (True, [shove(LEFT, 0.14)]),
        "carried": (True, carry(bring(y=0.15, z=0.08), bring(y=0.15), lift_m=0.08)),
    },
}


def bundle_of(kind: str) -> TaskBundle:
    """Return the benchmark's task of a kind, or another one's turned into it."""
    if kind == "push_left, 13 cm":
        found, kind = load_benchmark("push_left"), "push_left"
        large = replace(found.scene.manipulated, size_m=(0.13, 0.13, 0.13))
        found = replace(found, scene=replace(found.scene, objects=(large,)))
    elif kind == "generic":
        found = load_benchmark("push_left")
    elif kind == "place_onto":
        found = load_benchmark("push_next_to")
        block = replace(found.scene.others[0], size_m=(0.09, 0.09, 0.04))
        scene = replace(found.scene, objects=(load_benchmark("lift_up").scene.manipulated, block))
        found = replace(found, scene=scene, code=load_benchmark("lift_up").code)
    else:
        return load_benchmark(kind)
    return replace(found, kind=kind, scene=replace(found.scene, kind=kind))


@pytest.fixture(scope="module")
def worlds() -> Callable[[str], BatchEnv]:
    made: dict[str, BatchEnv] = {}

    def of(kind: str) -> BatchEnv:
        if kind not in made:
            made[kind] = BatchEnv(
                bundle_of(kind), SimConfig(fine=True), num_envs=WORLDS, seed=3, num_threads=1
            )
        return made[kind]

    return of


@pytest.mark.parametrize(
    ("kind", "what"), [(kind, what) for kind, scripts in SCRIPTS.items() for what in scripts]
)
def test_a_kind_is_what_its_words_say(worlds: Callable[[str], BatchEnv], kind: str, what: str):
    counts, script = SCRIPTS[kind][what]

    at_end, ever = played.play(worlds(kind), script)

    assert at_end.mean() >= 0.5 if counts else not ever.any()


def odd_starts(worlds: BatchEnv) -> list[np.ndarray]:
    """Return poses of all objects in which no honest task starts, of those that the checks of starts let pass."""
    scene, thing = worlds.bundle.scene, worlds.world.objects[0]
    placed = worlds.object_poses()[0]
    other = min(1, len(placed) - 1)
    half = placed[:, 2].copy()
    wide = (thing.size_m[0] + worlds.world.objects[other].size_m[0]) / 2

    def start(at=None, z: float = 0.0, lean: float = 0.0, of: int = 0) -> np.ndarray:
        """Put an object at a place from the other's centre, z above the table, turned about x on its lowest edge."""
        poses, obj = placed.copy(), worlds.world.objects[of]
        poses[of, 3:] = np.cos(lean / 2), np.sin(lean / 2), 0.0, 0.0
        turned = Rotation.from_rotvec([lean, 0.0, 0.0]).apply(obj.hull)
        poses[of, 2] = z - turned[:, 2].min()
        if at is not None:
            poses[of, :2] = poses[1 - of if other else 0, :2] + at
        return poses

    on_top = 2 * half[other]
    high = [
        start((x, y), on_top + z)
        for x, y in ((0, 0), (0.03, 0), (0, 0.04), (-0.04, 0.04))
        for z in (0.0, 0.009)
    ]
    leaning = [start(lean=np.deg2rad(a)) for a in (-80, -50, -35, 10, 20, 35, 50, 65, 80, 90, 180)]
    leaning += [start((0.0, s * (wide + 0.01)), lean=s * 0.4) for s in (-1, 1)]
    beside = [start((0.0, -wide - gap)) for gap in (0.001, 0.01, 0.031)] + [
        start((-wide - 0.02, 0.0))
    ]
    inside = [start((x, 0.0), z) for x in (0.0, 0.02) for z in (0.007, 0.012)]
    under = [start((0.0, 0.0), 2 * half[0], of=other)] if other else []
    lifted = [start(z=0.009), start((0.4, 0.6)), start((0.0, 0.0))]
    passed = []
    for poses in (*high, *leaning, *beside, *inside, *under, *lifted):
        rows = worlds.motion()[0][:1]
        first = thing.qpos_adr
        rows[0, first : first + poses.size] = poses.ravel()
        sizes, fields = worlds.randomizer.size_m[:1], worlds.randomizer.fields()
        with contextlib.suppress(ItemRejectedError):
            check_poses(worlds.world, sizes, poses[None], scene.title)
            check_start(worlds.world, fields, rows, np.array([0]), scene.title)
            passed.append(poses)
    return passed


@pytest.mark.parametrize("kind", list(KINDS))
def test_an_arm_that_does_nothing_or_anything_in_the_air_never_succeeds(kind: str):
    calm = SimConfig(fine=True, randomization=ranges.none())
    starts = np.array(odd_starts(BatchEnv(bundle_of(kind), calm, num_envs=1, seed=3)))

    class SoonDone(Task):
        """Starts each world oddly, and would call everything a success."""

        def reset_objects_states(self, env_ids: torch.Tensor) -> dict[str, torch.Tensor]:
            names = [o.name for o in bundle_of(kind).scene.objects]
            return {n: torch.from_numpy(starts[env_ids.numpy(), k]) for k, n in enumerate(names)}

        def compute_success(self, states: dict[str, torch.Tensor]) -> torch.Tensor:
            return states["progress"] > 0.02

        def compute_reward(
            self, actions: torch.Tensor, states: dict[str, torch.Tensor]
        ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
            return states["progress"], {}

    env = BatchEnv(
        bundle_of(kind), calm, num_envs=len(starts), seed=3, num_threads=1, task=SoonDone
    )
    rng = np.random.default_rng(0)

    def wander(m: Moment) -> np.ndarray:
        t = 7.0 * m.tool[:, :2].sum(1) + rng.uniform(0, 0.2)
        to = np.stack([0.5 + 0.15 * np.sin(3 * t), 0.2 * np.cos(t), 0.4 + 0.0 * t], axis=1)
        return m.go(to, np.sign(np.sin(9 * t)))

    def jerk(m: Moment) -> np.ndarray:
        action = rng.uniform(-1, 1, (len(m.tool), 7))
        action[:, 2] = np.abs(action[:, 2])
        return action

    actors = {"idle": [idle()], "random": [(60, jerk)], "wandering": [(60, wander)]}
    if KINDS[kind].must_grasp:
        actors["taking and leaving"] = [take(steps=50), let_go()]
    counted = {who: int(played.play(env, script)[1].sum()) for who, script in actors.items()}

    assert len(starts) >= 20
    assert counted == dict.fromkeys(actors, 0)
