"""Emulated devices: an emulator for every codec, with faults on the wire.

device: a device with its line; emulator: threads, pace, answers to commands; transmitter: sample
numbers, clock, packets; faults: the schedule and record of faults; endpoints and pseudo_terminal:
the device's end of a line.
"""
