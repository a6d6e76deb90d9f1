"""Feature learning: losses, stages, task, data and metrics."""
