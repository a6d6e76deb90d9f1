"""Learning and localizing on many machines, by Ray."""
