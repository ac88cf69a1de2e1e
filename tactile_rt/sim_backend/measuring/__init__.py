"""Measurement of a real array from a recording, and comparison with its description.

    recording -> rest, rings -> figures -> comparison with the description -> its file

Every measured figure has a 95 % interval. A quantity that cannot be measured is reported, and its
description stays as it is.
"""
