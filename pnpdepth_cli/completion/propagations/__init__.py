"""Propagations of the residual: each file defines `propagation`, a `Propagation`."""
