"""Twenty-eight kinds of thing, each drawn from a random stream.

A builder takes a generator and returns convex pieces whose union is the object, in its own unit
(about 1 for the largest extent; the caller normalises), z up, in its natural pose. The kinds are
chosen to be told apart by what passes in the middle half of their height, from any side: smooth
columns, ribs, lobes, teeth, wires, coils, rungs, seats, shelves, knobs, overhangs, wings.
"""
