"""Scene files: who stands where, how the robot drives, what its radars and wheels are like."""
