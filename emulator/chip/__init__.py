"""The X4 chip: settings, registers, clocks, downconversion, streams of frames."""
