"""The application: datasets, configuration, stages and the command line that join `completion` and `detection`."""

__version__ = "0.1.0"
