"""Query descriptors + compressed map -> places."""
