"""Experts that come with the package: one network a kind of task, which learned many random objects at once.

`pretrained/<kind>/` is an expert's folder in half precision. `pretrained/card.json` says how each was learned, and the
digest of its weights. `scripts/pretrain_experts.py` makes them again.
"""

from pathlib import Path
from typing import Any

from policies.ppo.policy import WEIGHTS_FILE, Expert
from v2p_data.errors import V2PError
from v2p_data.json_files import read_object
from v2p_data.pipeline.fingerprint import file_digest
from v2p_data.sim.robot.arms import RobotConfig, robot_to_json
from v2p_data.task.task import TaskBundle

FOLDER = Path(__file__).parent / "pretrained"
CARD_FILE = "card.json"


def card(folder: Path = FOLDER) -> dict[str, Any]:
    """Return the card: per kind how its expert was learned, its success on held-out objects, its digest."""
    path = folder / CARD_FILE
    return read_object(path, "install the package anew") if path.is_file() else {}


def pretrained_for(bundle: TaskBundle, folder: Path = FOLDER) -> Expert | None:
    """Return the expert of a task's kind; None where the task is beyond what it learned.

    That is another arm, more than two objects, or a kind without an expert.

    Raises:
        V2PError: its weights are not those of the card.
    """
    about = card(folder).get(bundle.kind)
    is_other_arm = bundle.robot not in ({}, robot_to_json(RobotConfig()))
    if about is None or is_other_arm or len(bundle.scene.objects) > 2:
        return None
    path = folder / bundle.kind / WEIGHTS_FILE
    if not path.is_file() or file_digest(path) != about["digest"]:
        raise V2PError(
            f"{path} is not the expert that {folder / CARD_FILE} names; install the package anew, or learn without it "
            "with --expert.start=program"
        )
    return Expert.load(path.parent)
