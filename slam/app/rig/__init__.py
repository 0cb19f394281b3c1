"""The radars of a robot: rig files, modules on ports, the emulated rig."""
