"""The version of the program, which every file may import."""

__version__ = "2.0.0"
