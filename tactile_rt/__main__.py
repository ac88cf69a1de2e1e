"""`python -m tactile_rt`: the command line of the Python that runs it."""

from tactile_rt.cli import main

if __name__ == "__main__":
    main()
