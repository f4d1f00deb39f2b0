"""The frame stages, one file each: what a stage reads of a frame, what it calls, what it writes."""
