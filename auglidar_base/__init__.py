"""What all three rooms stand on: files that appear whole, pickles read without running them. It imports no room."""
