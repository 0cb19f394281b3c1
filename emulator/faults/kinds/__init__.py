"""Every kind of fault, one file per layer that it hits."""
