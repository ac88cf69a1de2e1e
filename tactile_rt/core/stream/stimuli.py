"""Names of the six stimuli of the barrel-cortex recordings (Rodgers 2022)."""

SHAPES = ("convex", "concave")
DISTANCES = ("close", "medium", "far")
STIMULI = tuple(f"{shape}-{distance}" for shape in SHAPES for distance in DISTANCES)
