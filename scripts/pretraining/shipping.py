"""Which policies of a pretraining ship: the best on tasks held out for this choice, in half precision, with a card."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.torch import load_file, save_file

from policies.ppo.policy import WEIGHTS_FILE, Expert
from studies.results import commit
from v2p_data.experts.pretrained import CARD_FILE, FOLDER
from v2p_data.pipeline.artifact import write_json_atomically
from v2p_data.pipeline.fingerprint import file_digest

TAUGHT = "imitation of a scripted program on {tasks} random objects at once"
BY_PPO = f"{TAUGHT}, then {{steps:,}} steps of PPO"
PLACES = {"taught": "taught", "best": "ppo", "last": "ppo/last"}


def ship(runs: list[Path], folder: Path = FOLDER) -> dict[str, Any]:
    """Write the best policy of each kind among the runs' folders, and the card; return the card."""
    card: dict[str, Any] = {}
    for path in sorted(p for run in runs for p in run.glob("*/record.json")):
        record = json.loads(path.read_text(encoding="utf-8"))
        for name in (n for n in PLACES if f"choice_{n}" in record):
            rates = record[f"choice_{name}"]
            success = float(np.mean(rates["end"]))
            if success <= card.get(record["kind"], {}).get("chosen_at", -1.0):
                continue
            out = folder / record["kind"]
            Expert.load(path.parent / PLACES[name]).save(out)
            _halve(out / WEIGHTS_FILE)
            card[record["kind"]] = {
                "made_by": (TAUGHT if name == "taught" else BY_PPO).format(
                    **{"steps": 0} | record | record.get("ppo", {})
                ),
                "chosen_at": round(success, 4),
                "least": round(float(np.min(rates["end"])), 4),
                "chosen_on": f"{len(rates['end'])} random tasks that nothing was trained on, 24 episodes each",
                "seed": record["seed"],
                "commit": commit(),
                "digest": file_digest(out / WEIGHTS_FILE),
            }
    write_json_atomically(folder / CARD_FILE, card)
    return card


def _halve(path: Path) -> None:
    """Keep weights in half precision; the normaliser's counts need all digits."""
    weights = load_file(path)
    small = {k: v if k.startswith("normaliser") else v.half() for k, v in weights.items()}
    save_file(small, path)
