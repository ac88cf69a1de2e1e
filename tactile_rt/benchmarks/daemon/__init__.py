"""Benchmark area `daemon`: the real process between emulated arrays and live readers."""
