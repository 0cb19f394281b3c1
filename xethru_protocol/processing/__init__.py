"""What is done with radar frames: arrays in, arrays out.

Frames come first: an array has the shape (n_frames, n_bins), one row per frame. Rates are in hertz,
ranges in metres as the caller counts them. Nothing here knows a module, a file or a clock.
"""
