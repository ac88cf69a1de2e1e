"""What makes the project's figures and pictures. It runs from a checkout and is in no wheel.

sim drivers models inference daemon align perception   an area each: `tactile-rt bench AREA` has
            its `area` run
checks      programs that fail if an answer is no: export, wheel, aarch64, a run of days
pictures    scripts that redraw the pictures and tables of `docs/`
speed       whether this checkout is as fast as another
emulated    the emulated arrays of all rigs
processes   a function in a process of its own

Everything is started from the checkout's root, e.g. ``python -m bench.checks.wheel``.
"""
