"""The version of this release, which recordings, sweep sets and model files carry."""

__all__ = ["VERSION"]

VERSION = "0.2.0"
