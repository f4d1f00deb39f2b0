"""Each geometric question answered once: calibration, projection, back-projection, in view, rings."""
