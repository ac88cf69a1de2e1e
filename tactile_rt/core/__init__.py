"""What every room stands on: streams, settings, files and errors; no touch, no device, no model."""
