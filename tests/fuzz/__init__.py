"""Malformed inputs for every reader: `python -m tests.fuzz --cases 20000`, see runner.py."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1]))  # what all tests share
