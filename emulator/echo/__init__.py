"""Echo physics: from a scene and the true pose to integer chip counters."""
