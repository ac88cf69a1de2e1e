"""Objects that whiskers sweep past: parametric shapes, and mesh files cut into convex pieces."""
