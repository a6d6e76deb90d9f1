"""`python -m tests.golden [runs|frames|options] ...`: write the goldens anew."""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

import torch

from . import frames, options, runs

PARTS = ("runs", "frames", "options")


def main(words):
    unknown = set(words) - set(PARTS)
    if unknown:
        raise SystemExit(f"{', '.join(sorted(unknown))}: expected {', '.join(PARTS)}")
    torch.set_num_threads(1)
    chosen = words or PARTS
    if "options" in chosen:
        options.write()
    if "frames" in chosen:
        frames.write()
    if "runs" in chosen:
        data = os.environ.get("DEJAVU_TEST_DATA")
        if data is None:
            raise SystemExit("DEJAVU_TEST_DATA is not set; expected the folder of real data")
        for name in runs.RUNS:
            with tempfile.TemporaryDirectory() as folder:
                runs.write(name, Path(folder), Path(data))


if __name__ == "__main__":
    main(sys.argv[1:])
