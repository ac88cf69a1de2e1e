"""realtouch: what a model makes of real things that it never touched.

See `docs/reference/realtouch.md`.
"""
