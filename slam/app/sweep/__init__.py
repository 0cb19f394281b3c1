"""The same run over scenes, presets, settings, stresses and seeds."""
