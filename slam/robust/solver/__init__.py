"""The store of a run, and its solution by least squares."""
