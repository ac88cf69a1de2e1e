"""Sources of samples: a URL opens a device, a simulation, a recording or several of them."""
