"""A project: a folder with the description of an array and the model that is made for it.

folder.py    the files of a project folder, and how to create a new one
budget.py    the numbers of objects, sweeps and updates that fit into the given time
making.py    sweeps, training, export and evaluation, in this order, resumable
report.py    the report card: the results on one page
"""
