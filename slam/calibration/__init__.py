"""Range offsets, mounts and gains of a rig from one drive past reflectors."""
