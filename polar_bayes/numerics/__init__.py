"""Functions of arrays, which know no capture, scene or model."""
