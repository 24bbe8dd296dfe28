"""pnpdepth: better depth from any depth network and a few true points, without training."""

__version__ = "0.1.0"
