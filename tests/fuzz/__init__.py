"""Malformed inputs for every reader: `python -m tests.fuzz --cases 20000`, see runner.py."""
