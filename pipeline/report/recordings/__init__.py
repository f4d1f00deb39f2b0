"""Recordings of a run for viewers: Rerun (.rrd) and Foxglove (.mcap)."""
