"""`python -m tests.fuzz`, see runner.py."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # of what other tests share

from .runner import main

sys.exit(main())
