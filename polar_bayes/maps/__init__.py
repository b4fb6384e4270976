"""Many small posteriors at once: every pixel of an image is a fit of its own."""
