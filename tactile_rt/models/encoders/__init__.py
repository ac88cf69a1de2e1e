"""Encoders: frames `(batch, step, 30, 5, 7)` to features `(batch, step, feature)`."""
