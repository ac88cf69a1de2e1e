"""Measurement of a real array from a recording, and comparison with its description.

    recording -> rest, free swings -> estimates -> comparison with the description -> its file

Every estimate has a 95 % interval. A quantity that cannot be measured is reported, and its
described value stays.
"""
