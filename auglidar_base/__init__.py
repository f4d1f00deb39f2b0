"""What all three rooms stand on: whole files, inert pickles, children that end. It imports no room."""
