"""Benchmark area `drivers`: real drivers at one end of a line, emulated devices at the other."""
