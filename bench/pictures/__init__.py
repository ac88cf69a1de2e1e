"""Scripts that redraw the pictures and tables of `docs/`."""
