"""tactile_rt: whisker and taxel arrays in, what they touch out, in real time."""

__version__ = "0.1.0"
