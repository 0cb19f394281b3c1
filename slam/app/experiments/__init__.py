"""What is run on data that is not ours: `benchmarks`."""
