"""Where frames and truth come from."""
