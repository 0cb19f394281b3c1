"""property tests of slam.paper."""
