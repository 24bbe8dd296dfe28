"""The paper's method on torch tensors: the cut, the refinement of z, losses and metrics."""
