"""An X4M300 to any program that opens its pty, playing back echo scenes."""
