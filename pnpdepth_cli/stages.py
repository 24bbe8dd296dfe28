"""The stages of a depth whose errors are measured, and what they are measured on."""

BEFORE, AFTER, LINEAR = "before", "after", "linear"
"""The user's network, aligned with the points; the result; linear interpolation of all points."""
UPDATED, PROPAGATED, ALONE = "updated", "propagated", "alone"
"""Stages of the default method: the user's network after the updates of z, and after propagation of
the residual; the network that takes a prior, without one."""

GT, HELD_OUT, VALIDATION, USED = "ground_truth", "held_out", "validation", "used"
BASES = {
    GT: "against ground truth",
    HELD_OUT: "at held-out points",
    VALIDATION: "at validation points",
    USED: "at points used",
}
"""What errors are measured on, the best first. A change at the points used means nothing."""
