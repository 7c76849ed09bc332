"""Who demonstrates a task and labels a student's states: a network that learned it, or the scripted program itself."""

from pathlib import Path
from typing import TYPE_CHECKING

from v2p_data.experts.config import ExpertConfig
from v2p_data.json_files import read_object
from v2p_data.pipeline.artifact import write_json_atomically

if TYPE_CHECKING:  # they load torch and MuJoCo, and this file is read for listing too
    from policies.ppo.policy import Expert
    from v2p_data.experts.learning import Worlds
    from v2p_data.experts.record import Learned
    from v2p_data.play import Actor

PROGRAM_FILE = "program.json"
"""File of an expert that is a program; it has no weights."""


def choose_program(worlds: "Worlds", cfg: ExpertConfig, out: Path) -> "Learned":
    """Try the programs, write the best one's name into `out`, and say that nothing was learned."""
    from v2p_data.experts.record import Learned
    from v2p_data.experts.teacher import Teacher

    env = worlds.make(cfg.trial_worlds, "trials", fine=True)  # where it will act
    teacher = Teacher(env)
    best = teacher.choose(env)
    write_json_atomically(out / PROGRAM_FILE, {"program": best.name})
    return Learned(
        steps=len(teacher.trials) * cfg.trial_worlds * worlds.bundle.horizon_steps,
        seconds=0.0,
        actor_updates=0,
        teacher=best.name,
        trials=teacher.trials,
        comparison=None,
        stopped_by="",
        is_program=True,
    )


def program_in(folder: Path) -> str | None:
    """Return the program that an expert's folder names, None where a network learned."""
    if not (folder / PROGRAM_FILE).is_file():
        return None
    return str(read_object(folder / PROGRAM_FILE, "make the expert anew").get("program"))


def labeller_of(folder: Path) -> "Actor":
    """Return who acts as the expert in a folder does: from any state, without memory."""
    from policies.ppo.policy import Expert
    from v2p_data.experts.actors import ProgramActor

    if (name := program_in(folder)) is not None:
        return ProgramActor(0, name)
    return network_actor(Expert.load(folder))


def network_actor(expert: "Expert") -> "Actor":
    """Return an actor that sees what the expert was trained on, which may be the first numbers only."""
    from v2p_data.play import StateActor

    return StateActor(lambda obs: expert.act(obs[:, : expert.model.obs_dim]))
