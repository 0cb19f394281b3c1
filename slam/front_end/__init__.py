"""Front ends: raw radar frames in, ranges of echoes out."""
