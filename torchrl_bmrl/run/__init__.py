"""The folder and the processes of a run: settings, locks, stops, workers, progress."""
