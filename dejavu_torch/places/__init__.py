"""Where the places of a map lie."""
