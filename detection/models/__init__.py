"""Networks of the detectors; the ones to ask for by name are in `detection.models.presets`."""
