"""Frames (N,C,H,W) -> features (N,D)."""
