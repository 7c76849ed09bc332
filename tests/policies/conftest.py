"""Lets the tests share the toy environment of `point_mass.py`."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
