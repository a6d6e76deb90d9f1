"""Feature learning: losses, task, data, metrics."""
