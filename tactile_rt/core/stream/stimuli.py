"""The six stimuli of the barrel-cortex recordings (Rodgers 2022): an axis that rooms share."""

__all__ = ["DISTANCES", "SHAPES", "STIMULI"]

SHAPES = ("convex", "concave")
DISTANCES = ("close", "medium", "far")
STIMULI = tuple(f"{shape}-{distance}" for shape in SHAPES for distance in DISTANCES)
