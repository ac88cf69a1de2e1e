"""Devices that are not there: an emulator for every codec, and what goes wrong on a wire.

device: a device with its line, as users plug it in; emulator: threads, pace, answers to commands;
transmitter: numbers, clock, packets; faults: what goes wrong, and the record of it; endpoints and
pseudo_terminal: the device's end of a line.
"""
