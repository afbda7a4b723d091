"""A run's folder and its processes: settings, locks, stops, workers, progress."""
