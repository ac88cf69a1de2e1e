"""Encoders: frames `(batch, step, channel, row, column)` to features `(batch, step, feature)`."""

MOUSE_FRAME = (30, 5, 7)  # five sub-steps of six loads, on the grid of a mouse's whiskers
