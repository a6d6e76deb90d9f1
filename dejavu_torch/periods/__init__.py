"""Features -> which of them repeat, where, and how often."""
