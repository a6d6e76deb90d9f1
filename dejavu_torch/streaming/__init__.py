"""Long routes, learned chunk by chunk: in bounded memory, again after a kill, on many machines."""
