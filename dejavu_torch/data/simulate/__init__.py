"""Routes that are painted rather than filmed, so that the truth is known."""
