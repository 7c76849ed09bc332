from pathlib import Path

import pytest

import simulate_scale
from v2p_data.pipeline import workers
from v2p_data.pipeline.runner import Runtime


@pytest.mark.parametrize("is_bare", [True, False])
def test_the_simulation_makes_every_item_but_the_rejected_ones(tmp_path, is_bare, monkeypatch):
    monkeypatch.setattr(workers, "_engine", workers._engine)
    cfg = simulate_scale.ScaleConfig(items=3, bare=is_bare)

    told = simulate_scale.simulate(cfg, tmp_path)

    assert told["stages"] == {"blocked": 2, "made": 6, "rejected": 1}


def test_twice_as_many_items_ask_the_scheduler_for_twice_as_much(monkeypatch):
    asked = []
    key = workers._key
    monkeypatch.setattr(workers, "_key", lambda stage: asked.append(stage) or key(stage))
    monkeypatch.setattr(
        workers, "_engine", lambda runtime, num_pending: simulate_scale.AtOnce(runtime.root)
    )
    counts = []
    for num_items in (50, 100):
        asked.clear()
        stages = [simulate_scale.chain(k, 0.0) for k in range(num_items)]
        workers.run_stages(stages, Runtime(root=Path("nowhere")), lambda event: None)
        counts.append(len(asked))

    assert counts[1] == 2 * counts[0]
