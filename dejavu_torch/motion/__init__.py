"""Frames -> frames at even steps along the ground (section IV-B)."""
