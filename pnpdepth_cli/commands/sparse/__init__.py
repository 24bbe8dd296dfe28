"""The commands that make sparse depth: project, sample and simulate."""
