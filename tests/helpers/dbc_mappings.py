"""Mappings of DBC files for codec can-dbc."""


def map_signal(dbc, channel, signal):
    """Return the TOML text that maps one signal, in N, to an array of one element."""
    return f"""dbc = "{dbc}"
name = "pad"
rate_hz = 100.0
channel = [{{ name = "{channel}", unit = "N" }}]
element = [{{ name = "S", grid = [0, 0], signals = {{ {channel} = "{signal}" }} }}]
"""
