"""One run: settings, folder, checkpoints, resuming, progress."""
