"""What a running profile computes from its radar: presence, baseband, pulse-Doppler, noise map."""
