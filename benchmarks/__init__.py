"""Benchmarks of the package against what users would pick instead."""
