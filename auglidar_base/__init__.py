"""What all three rooms stand on: whole files, inert pickles, children that end, and what trainers share.

It imports no room.
"""
