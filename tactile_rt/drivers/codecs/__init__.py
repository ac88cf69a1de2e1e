"""One small module per device."""
