"""Twenty-eight kinds of object, each drawn at random.

A builder takes a generator and returns convex pieces whose union is the object, in its own unit
(about 1 for the largest extent; the caller normalises), z up, in its natural pose. The kinds are
chosen to differ, from any side, in the middle half of their height: smooth columns, ribs, lobes,
teeth, wires, coils, rungs, seats, shelves, knobs, overhangs, wings.
"""
