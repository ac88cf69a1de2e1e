"""A real array measured from a recording of it, and how far it is from its description.

    recording -> rest, rings -> figures -> beside the description -> its file

What is measured has an interval, in which the truth lies in 19 cases of 20. What cannot be measured
is said, and stays as it was described.
"""
