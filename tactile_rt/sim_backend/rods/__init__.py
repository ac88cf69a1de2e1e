"""Whiskers as chains of rigid links, stepped one whisker at a time, with hard contacts.

The mechanics are those of the MuJoCo model of `world`, joint for joint; only contact differs.
MuJoCo finds contacts at the beginning of a step, so a light tip that has left a surface falls
through it in one step, unless a soft layer thicker than the whisker prevents it. Here nothing
overlaps at the end of a step: every surface within reach constrains the velocity at its end. See
`stepping`.
"""
