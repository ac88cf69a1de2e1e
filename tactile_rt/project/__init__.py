"""A project: a folder that goes from the description of an array to a robot that decides.

folder.py    what the folder holds, and how a new one begins
plan.py      what fits into the time given
making.py    sweeps, training, export, evaluation, one after the other, resumable
report.py    what came of it, on one page
"""
