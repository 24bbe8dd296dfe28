"""Golden output of the command line: see `python -m benchmarks.golden --help`."""
