"""Methods from cheap to exact, and the one that climbs them by itself."""
