"""UWB-radar SLAM: one module per stage of the paper, pure cores, no I/O."""
