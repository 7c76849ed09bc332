"""Lets the tests of grounding share `drawn_parts.py`."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
