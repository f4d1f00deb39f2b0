"""What everything uses: atomic files, seeds, errors, settings, paths, versions, progress."""
