"""A frame of a data set, and how its parts are read."""
