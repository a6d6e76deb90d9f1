"""Places + truth -> figures."""
