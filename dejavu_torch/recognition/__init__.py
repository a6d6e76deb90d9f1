"""Query features + compressed map -> place."""
