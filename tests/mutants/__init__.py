"""Sentences of behaviour, each with an edit that breaks it and the tests that must notice; see runner.py."""
