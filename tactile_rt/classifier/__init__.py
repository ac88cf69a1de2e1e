"""From samples to decisions: what a model file is, contact, windows, steps and early exits."""
