"""The version of the program, which every file may import."""

__version__ = "2.1.0"
