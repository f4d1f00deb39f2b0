"""The train stage: frames of a data set as samples of the libraries' training loops."""
