"""From samples to decisions: model files, contact detection, windows, steps and early exits."""
