"""Whole runs made of the rooms before this one."""
