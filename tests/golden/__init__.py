"""What the package did before its rooms were rebuilt: reports, matches, simulated frames and options.

`python -m tests.golden` writes the files of this folder anew, `python -m tests.golden runs frames options`
some of them; CONTRIBUTING.md says when that is allowed. tests/test_golden.py compares.
"""
