"""From places and a ground truth to scores, pictures and reports."""
