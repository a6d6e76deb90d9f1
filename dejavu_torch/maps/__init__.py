"""Plan + features -> compressed map."""
