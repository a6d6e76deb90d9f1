"""Frames as they come -> places, one by one."""
