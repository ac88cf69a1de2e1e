"""Roads of a new user, each walked to its end from an empty folder and a wheel.

    python -m bench.roads                      # all but LeRobot, with every Python that is here
    python -m bench.roads base --installers uv --pythons 3.12
    python -m bench.roads lerobot              # gigabytes of other packages; needs uv

base     the base install to a right decision, a recording and back, a table, a lesson
page     `config example` to decisions on the page
extras   each extra alone, and the first command that its page has
lerobot  LeRobot's own command line, with and without the plug-in's sensors

A step that fails ends its road; the exit code is 1 if any road ends early.
"""
