"""The folder of a run: its configuration, its weights, the outputs of its frames."""
