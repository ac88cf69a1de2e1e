"""Recordings in the hands of other people's programs."""
