"""Frames -> frames resampled by distance, to even steps along the ground (section IV-B)."""
