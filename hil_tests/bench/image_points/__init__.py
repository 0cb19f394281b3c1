"""Points and lines of images against emulated truth: `python -m hil_tests.bench.image_points`."""
