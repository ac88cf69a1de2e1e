"""Encoders of frames `(batch, step, channel, row, column)` to features `(batch, step, feature)`."""
