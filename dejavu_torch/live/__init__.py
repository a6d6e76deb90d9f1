"""Live localization: a camera's frames -> places, one by one, and a page that shows them."""
