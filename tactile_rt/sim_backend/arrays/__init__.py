"""Whiskers, how they are mounted on a head, and the files that describe both."""
