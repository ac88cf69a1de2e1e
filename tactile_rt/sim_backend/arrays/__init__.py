"""Whiskers, their mounting on a head, and the files that describe both."""
