"""Drivers for real arrays: wire codecs, serial and CAN sources."""
