"""`python -m tests.mutants [12 40-50] [--check]`, see runner.py."""

from __future__ import annotations

import sys

from .runner import main

if __name__ == "__main__":
    sys.exit(main())
