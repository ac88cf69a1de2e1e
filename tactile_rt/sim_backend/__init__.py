"""Whisker arrays, objects and sweeps simulated in MuJoCo (extra ``sim``)."""
