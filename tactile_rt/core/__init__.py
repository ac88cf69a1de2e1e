"""Base of all packages: streams, settings, files, errors; nothing of touch, devices or models."""
