"""Descriptors -> compressed maps, which score queries."""
