"""A range-only SLAM back end: right-invariant filter, joint association and relinearisation."""
