"""What each effect of a scene changes, and what it costs."""
