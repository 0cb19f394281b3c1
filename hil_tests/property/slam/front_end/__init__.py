"""property tests of slam.front_end."""
