"""Property tests of slam.robust."""
