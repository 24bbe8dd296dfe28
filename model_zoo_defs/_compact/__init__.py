"""The parts of `model_zoo_defs.compact`."""
