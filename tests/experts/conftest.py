"""The worlds of the tests of the simulator."""

import runpy
from pathlib import Path

_sim = runpy.run_path(str(Path(__file__).parents[1] / "sim" / "conftest.py"))
make_bundle = _sim["make_bundle"]
lift_task = _sim["lift_task"]
