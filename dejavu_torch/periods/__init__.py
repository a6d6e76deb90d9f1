"""Features -> the periods with which they repeat."""
