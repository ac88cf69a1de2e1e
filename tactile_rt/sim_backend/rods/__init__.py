"""Whiskers as chains of rigid links that are stepped one by one, with hard contacts.

The mechanics are those of the MuJoCo model of `world`, joint for joint; what differs is contact.
MuJoCo looks at where things are when a step begins, so a light tip that leaves a surface falls
through it in one step, and only a soft layer thicker than the whisker keeps it from that. Here a
step ends where nothing overlaps: every surface within reach is a constraint on the velocity with
which the step ends. See `stepping`.
"""
