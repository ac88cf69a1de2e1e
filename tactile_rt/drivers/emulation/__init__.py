"""Devices that are not there: an emulator for every codec, and what goes wrong on a wire."""
